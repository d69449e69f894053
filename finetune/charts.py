"""Charts as SVG text, to stand in a page of their own without any script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

_WIDTH, _HEIGHT = 460, 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 14, 30, 44


@dataclass(frozen=True)
class Series:
    """A line through points."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str


@dataclass(frozen=True)
class Level:
    """A horizontal line to compare with."""

    name: str
    y: float
    colour: str


@dataclass(frozen=True)
class Region:
    """A shaded part of the x axis."""

    name: str
    start: float
    stop: float
    colour: str


def line_chart(
    title: str,
    x_label: str,
    series: Sequence[Series],
    *,
    levels: Sequence[Level] = (),
    regions: Sequence[Region] = (),
    y_range: tuple[float, float] | None = None,
    percent: bool = False,
) -> str:
    """Return the lines as SVG.

    Args:
        title: what is on the y axis.
        x_label: what is on the x axis.
        series: the lines; values that are not finite are left out.
        levels: to compare with.
        regions: what the x axis means in parts.
        y_range: lowest and highest y; that of the values if left out.
        percent: write the y axis in percent.
    """
    points = [[p for p in zip(s.x, s.y, strict=True) if all(map(math.isfinite, p))] for s in series]
    xs = [x for line in points for x, _ in line]
    xs += [edge for region in regions for edge in (region.start, region.stop)]
    ys = [y for line in points for _, y in line] + [level.y for level in levels]
    x_ticks = ticks(min(xs, default=0.0), max(xs, default=1.0), 6)
    y_ticks = ticks(*(y_range or (min(ys, default=0.0), max(ys, default=1.0))), 5)
    frame = _Frame(min(xs, default=0.0), max(xs, default=1.0), y_ticks[0], y_ticks[-1])
    parts = [frame.region(region) for region in regions]
    parts += [frame.y_tick(y, f"{y:.0%}" if percent else _number(y)) for y in y_ticks]
    parts += [frame.x_tick(x, _number(x)) for x in x_ticks if frame.x_low <= x <= frame.x_high]
    parts += [frame.level(level) for level in levels]
    parts += [frame.line(s, line) for s, line in zip(series, points, strict=True) if line]
    return _svg(title, x_label, parts)


def bar_chart(
    title: str, x_label: str, names: Sequence[str], groups: Sequence[tuple[str, Sequence[int], str]]
) -> str:
    """Return stacked bars as SVG.

    Args:
        title: what is counted.
        x_label: what the names are.
        names: of the bars.
        groups: name, one count for each bar, and colour; the first stands lowest.
    """
    totals = [sum(counts) for counts in zip(*(counts for _, counts, _ in groups), strict=True)]
    y_ticks = [y for y in ticks(0.0, max(1, *totals), 5) if y == round(y)]
    frame = _Frame(0.0, float(len(names)), 0.0, max(y_ticks[-1], *totals))
    parts = [frame.y_tick(y, _number(y)) for y in y_ticks]
    parts += [frame.x_tick(i + 0.5, name) for i, name in enumerate(names)]
    base = [0] * len(names)
    for name, counts, colour in groups:
        for i, count in enumerate(counts):
            if count:
                top, bottom = frame.y(base[i] + count), frame.y(base[i])
                left, width = frame.x(i + 0.12), frame.x(0.76) - frame.x(0)
                parts.append(
                    f'<rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" '
                    f'height="{bottom - top:.1f}" fill="{colour}">'
                    f"<title>{escape(name)}: {count}</title></rect>"
                )
                base[i] += count
    return _svg(title, x_label, parts)


def ticks(low: float, high: float, most: int) -> list[float]:
    """Return at most ``most + 1`` round numbers, evenly spaced, that span low to high."""
    if high <= low:
        low, high = low - 0.5, high + 0.5
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step *= next(m for m in (1, 2, 2.5, 5, 10, 20) if (high - low) / (step * m) <= most - 1)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


class _Frame:
    """Where numbers are on the picture."""

    def __init__(self, x_low: float, x_high: float, y_low: float, y_high: float) -> None:
        self.x_low, self.x_high = x_low, max(x_high, x_low + 1e-9)
        self.y_low, self.y_high = y_low, max(y_high, y_low + 1e-9)

    def x(self, value: float) -> float:
        share = (value - self.x_low) / (self.x_high - self.x_low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        share = (value - self.y_low) / (self.y_high - self.y_low)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    def x_tick(self, value: float, text: str) -> str:
        x, y = self.x(value), _HEIGHT - _BOTTOM
        return f'<text class="tick" x="{x:.1f}" y="{y + 16}" text-anchor="middle">{text}</text>'

    def y_tick(self, value: float, text: str) -> str:
        y = self.y(value)
        return (
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text class="tick" x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
        )

    def level(self, level: Level) -> str:
        y = self.y(level.y)
        return (
            f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="{level.colour}" stroke-width="1.5" stroke-dasharray="5 4"/>'
            f'<text class="label" x="{_WIDTH - _RIGHT - 4}" y="{y - 4:.1f}" text-anchor="end" '
            f'style="fill:{level.colour}">{escape(level.name)}</text>'
        )

    def region(self, region: Region) -> str:
        left, right = self.x(region.start), self.x(region.stop)
        text = ""
        if right - left > 6 * len(region.name):  # else it would run into its neighbour
            text = (
                f'<text class="label" x="{(left + right) / 2:.1f}" y="{_HEIGHT - _BOTTOM - 8}" '
                f'text-anchor="middle">{escape(region.name)}</text>'
            )
        return (
            f'<rect x="{left:.1f}" y="{_TOP}" width="{right - left:.1f}" '
            f'height="{_HEIGHT - _TOP - _BOTTOM}" fill="{region.colour}"/>{text}'
        )

    def line(self, series: Series, points: Sequence[tuple[float, float]]) -> str:
        places = [(self.x(x), self.y(y)) for x, y in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        dots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{series.colour}">'
            f"<title>{escape(series.name)}: {b:.4g} at {a:.4g}</title></circle>"
            for (x, y), (a, b) in zip(places, points, strict=True)
        )
        return (
            f'<polyline points="{path}" fill="none" stroke="{series.colour}" stroke-width="2"/>'
            + dots
        )


def _svg(title: str, x_label: str, parts: Sequence[str]) -> str:
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">'
        f'<text class="title" x="{_LEFT}" y="16">{escape(title)}</text>'
        + "".join(parts)
        + f'<text class="axis" x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 8}" '
        f'text-anchor="middle">{escape(x_label)}</text></svg>'
    )


def _number(value: float) -> str:
    """Return a tick's number, short: 250k, 1.5M, 0.25."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}".replace("-", "−")
    return f"{value:g}".replace("-", "−")
