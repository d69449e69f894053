"""The table of results: before and after fine-tuning, beside the paper and the oracle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Plain = Mapping[str, Any]
"""An evaluation as ``Evaluation.to_plain`` gives it."""

HEAD = ("", "success at the last step", "success at any step", "return", "relative to the oracle")


@dataclass(frozen=True)
class Figure:
    """A number, and its 95% interval where it has one; both as text."""

    value: str
    interval: str = ""

    def __str__(self) -> str:
        return f"{self.value} {self.interval}".rstrip()


Row = tuple[str, tuple[Figure, ...]]
_UNKNOWN = Figure("–")


def percent(value: float) -> str:
    """Return a share as text, in percent; one of 99.8% has not been 100%."""
    digits = 1 if 0.99 < value < 0.9995 else 0
    return f"{100 * value:.{digits}f}%".replace("-", "−")


def signed(value: float) -> str:
    """Return a return as text."""
    return f"{value:.1f}".replace("-", "−")


def result_rows(before: Plain | None, after: Plain | None) -> list[Row]:
    """Return name and figures, in the order of ``HEAD``, of all that is known."""
    rows: list[Row] = []
    for name, evaluation in (("Before fine-tuning", before), ("After fine-tuning", after)):
        if evaluation:
            rows.append((name, tuple(_figure(evaluation.get(key), f) for key, f in _COLUMNS)))
    known = after or before or {}
    paper, oracle = known.get("paper_return"), known.get("oracle_return")
    if paper is not None:
        relative = _relative(paper, oracle, known["task"])
        figures = (_UNKNOWN, _UNKNOWN, Figure(signed(paper)), relative)
        rows.append(("The paper (EISP, Table II)", figures))
    if oracle is not None:
        figures = (_UNKNOWN, _UNKNOWN, Figure(signed(oracle)), Figure("100%"))
        rows.append(("Oracle (noise-free script)", figures))
    return rows


def results_text(before: Plain | None, after: Plain | None) -> str:
    """Return the table for a terminal."""
    lines = [HEAD, *((name, *map(str, figures)) for name, figures in result_rows(before, after))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _figure(estimate: Mapping[str, float] | None, form: Callable[[float], str]) -> Figure:
    if not estimate:
        return _UNKNOWN
    return Figure(form(estimate["mean"]), f"[{form(estimate['low'])}, {form(estimate['high'])}]")


def _relative(value: float, oracle: float | None, task: str) -> Figure:
    """Return (R + L) / (R_oracle + L)."""
    from eisp_data.tasks.images import state_task
    from eisp_data.tasks.registry import TASKS

    task = state_task(task)
    if oracle is None or task not in TASKS:
        return _UNKNOWN
    length = TASKS[task].paper.episode_steps
    return Figure(percent((value + length) / (oracle + length)))


_COLUMNS = (
    ("success_last", percent),
    ("success_any", percent),
    ("return", signed),
    ("relative_return", percent),
)
