"""The frame of a self-contained page: no script, nothing fetched from anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_STYLE = """
:root { color-scheme: light; --ink: #0f172a; --soft: #475569; --line: #e2e8f0; --wash: #f8fafc; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--wash); color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1020px; margin: 0 auto; padding: 36px 24px 64px; }
h1 { font-size: 27px; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 18px; margin: 40px 0 8px; }
p { margin: 6px 0 12px; color: var(--soft); max-width: 76ch; }
.lead { font-size: 16px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(200px, 1fr)); gap: 14px;
  margin: 22px 0 6px; }
.card, .box { background: #fff; border: 1px solid var(--line); border-radius: 10px; }
.card { padding: 14px 18px; }
.card b { display: block; font-size: 28px; line-height: 1.2; font-variant-numeric: tabular-nums; }
.card span { color: var(--soft); font-size: 13.5px; }
.box { padding: 12px 14px; overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: 8px 12px; text-align: right; border-bottom: 1px solid var(--line); }
th { font-weight: 600; font-size: 13.5px; color: var(--soft); }
td { white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
tbody tr:last-child td { border-bottom: 0; }
tr.strong td { font-weight: 650; }
small { color: var(--soft); font-weight: 400; }
.pair { display: grid; gap: 14px;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 420px), 1fr)); }
svg { width: 100%; height: auto; display: block; }
svg text { font-size: 11px; fill: #475569; }
svg .title { font-size: 13px; font-weight: 600; fill: #0f172a; }
svg .axis { font-size: 12px; }
svg .label { paint-order: stroke; stroke: #fff; stroke-width: 3px; }
svg .grid { stroke: #e2e8f0; stroke-width: 1; }
video { width: 100%; max-width: 640px; border-radius: 8px; display: block; background: #000; }
.key i { display: inline-block; width: 11px; height: 11px; border-radius: 3px;
  margin: 0 6px 0 14px; vertical-align: -1px; }
.key i:first-child { margin-left: 0; }
pre { font: 12.5px/1.5 ui-monospace, SFMono-Regular, Menlo, "DejaVu Sans Mono", monospace;
  margin: 8px 0; white-space: pre-wrap; }
summary { cursor: pointer; font-weight: 600; }
footer { margin-top: 44px; font-size: 13px; color: var(--soft); }
"""


def page(title: str, sections: Sequence[str]) -> str:
    """Return the whole page; the sections are HTML."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(section for section in sections if section)
        + "\n</main>\n</body>\n</html>\n"
    )


def section(heading: str, text: str, *parts: str) -> str:
    """Return a section: what is to be seen, in words (plain text), and then the parts (HTML)."""
    return "\n".join(
        [f"<section><h2>{escape(heading)}</h2>", paragraph(text), *parts, "</section>"]
    )


def paragraph(text: str) -> str:
    """Return a paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def cards(entries: Sequence[tuple[str, str]]) -> str:
    """Return big numbers with what they are, both plain text."""
    inner = "".join(
        f"<div class=card><b>{escape(n)}</b><span>{escape(t)}</span></div>" for n, t in entries
    )
    return f"<div class=cards>{inner}</div>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], strong: int | None = None) -> str:
    """Return a table of HTML cells; row number ``strong`` stands out."""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = [
        f"<tr{' class=strong' if i == strong else ''}>"
        + "".join(f"<td>{cell}</td>" for cell in row)
        + "</tr>"
        for i, row in enumerate(rows)
    ]
    body = "".join(lines)
    return (
        f"<div class=box><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def pair(*charts: str) -> str:
    """Return charts side by side where there is room."""
    return (
        "<div class=pair>" + "".join(f"<div class=box>{chart}</div>" for chart in charts) + "</div>"
    )


def key(entries: Sequence[tuple[str, str]]) -> str:
    """Return what the colours mean: (colour, plain text)."""
    inner = "".join(f'<i style="background:{c}"></i>{escape(t)}' for c, t in entries)
    return f'<p class="key">{inner}</p>'


def details(summary: str, text: str) -> str:
    """Return plain text that is folded away."""
    return (
        f"<div class=box><details><summary>{escape(summary)}</summary>"
        f"<pre>{escape(text)}</pre></details></div>"
    )
