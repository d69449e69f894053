"""What happened in a recording: distances over time, and what was meant when."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eisp_data.errors import DataError
from eisp_data.robots.session import mean_distance_m
from eisp_data.storage.mcap import decode
from eisp_data.storage.mcap.reader import Entry, McapLog
from finetune.charts import Level, Series, line_chart

_ACHIEVED, _GOAL, _SUBGOAL, _EVENTS = "/achieved_goal", "/desired_goal", "/subgoal", "/events"
_DRAWN_EVERY_S = 0.2
_COLOURS = ("#2563eb", "#dc2626", "#059669", "#d97706", "#7c3aed", "#0891b2")
_STYLE = (
    "<style>text{font:12px system-ui,sans-serif;fill:#475569}.title{font-weight:600;fill:#0f172a}"
    ".grid{stroke:#e2e8f0}</style>"
)


@dataclass
class Trace:
    """One episode."""

    start_ns: int
    end_ns: int = 0
    times_ns: list[int] = field(default_factory=list)
    achieved: list[np.ndarray] = field(default_factory=list)
    """(G,) m at each time."""
    goal: np.ndarray = field(default_factory=lambda: np.empty(0))
    """(G,) m."""
    subgoals: list[tuple[int, np.ndarray]] = field(default_factory=list)
    """From when on which (G,) was the subgoal."""

    def distances_m(self) -> np.ndarray:
        """Return the paper's distance to the goal at each time, (N,)."""
        return np.array([mean_distance_m(achieved, self.goal) for achieved in self.achieved])

    def subgoal_at(self, time_ns: int) -> np.ndarray | None:
        """Return the subgoal (G,) at a time, None before the first."""
        before = [subgoal for start, subgoal in self.subgoals if start <= time_ns]
        return before[-1] if before else None


def read_traces(path: Path) -> list[Trace]:
    """Return the episodes of a recording that got as far as to move; DataError if it is damaged."""
    decoder = decode.Decoder()
    traces: list[Trace] = []
    with McapLog(path) as log:
        for entry in log.messages({_ACHIEVED, _GOAL, _SUBGOAL, _EVENTS}):
            schema = log.schema_of(entry.channel)
            _take(traces, entry, decoder.decode(entry.channel, schema, entry.message.data))
        if log.problems:
            raise DataError(f"{path}: {log.problems[0]}")
    return [trace for trace in traces if trace.times_ns and len(trace.goal)]


def _take(traces: list[Trace], entry: Entry, decoded: decode.Decoded) -> None:
    at = entry.message.publish_time_ns
    if isinstance(decoded, decode.Event):
        if decoded.kind == "episode_start":
            traces.append(Trace(at))
        elif decoded.kind == "episode_end" and traces and not traces[-1].end_ns:
            traces[-1].end_ns = at
        return
    if not isinstance(decoded, decode.Vector) or not traces:
        return
    trace = traces[-1]
    if entry.topic == _GOAL:
        trace.goal = decoded.values
    elif entry.topic == _ACHIEVED:
        trace.times_ns.append(at)
        trace.achieved.append(decoded.values)
    elif not trace.subgoals or not np.array_equal(trace.subgoals[-1][1], decoded.values):
        trace.subgoals.append((at, decoded.values))


def distance_curve(traces: list[Trace], first: int, tolerance_m: float) -> str:
    """Return the paper's Fig. "distance" as an SVG file: distance to the goal over time.

    Args:
        traces: of episodes.
        first: number of the first of them.
        tolerance_m: drawn as a line.
    """
    series = []
    for number, trace in enumerate(traces, start=first):
        times_s = (np.array(trace.times_ns) - trace.times_ns[0]) / 1e9
        every = max(1, round(_DRAWN_EVERY_S * len(times_s) / max(times_s[-1], 1e-9)))
        series.append(
            Series(
                f"episode {number}",
                times_s[::every].tolist(),
                trace.distances_m()[::every].tolist(),
                _COLOURS[number % len(_COLOURS)],
            )
        )
    chart = line_chart(
        "Mean distance of the objects to the goal, m",
        "s",
        series,
        levels=[Level(f"{tolerance_m:g} m", tolerance_m, "#475569")],
    )
    head, _, rest = chart.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg">{_STYLE}{rest}'
