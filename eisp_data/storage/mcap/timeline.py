"""When the rows of an episode are, and for which time each source is asked there.

Rows lie at ``first action + k / rate``; the first is the first action before which every source
has a sample.
"""

from __future__ import annotations

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.mcap.build import GOAL, STATE
from eisp_data.storage.mcap.collect import Clock, Source
from eisp_data.storage.mcap.resample import NANOSECONDS, longest_usual_gap_ns, pick, usual_gap_ns
from eisp_data.storage.mcap.sources import Recording
from eisp_data.storage.mcap.windows import Window, cut

MAX_EPISODE_BYTES = 2 * 2**30
"""The most that one episode may hold in memory, its images included."""


def check_clocks(recording: Recording, clock: Clock) -> None:
    """Raise DataError if a source never overlaps the actions: its clock must be another."""
    commands = recording.commands
    for source in recording.sources:
        first, last = source.series.times_ns[[0, -1]]
        # What is said once, like a goal or the pose of a fixed thing, may well come before.
        at_a_rate = source.stream.camera is not None or source.stream.to == STATE
        if first > commands.times_ns[-1] or (at_a_rate and last < commands.times_ns[0]):
            apart_s = (first - commands.times_ns[0]) / NANOSECONDS
            other = "log" if clock == "hardware" else "hardware"
            raise DataError(
                f"{recording.path}: {source.stream.topic} begins {apart_s:.6g} s after the actions "
                f"and never overlaps them; if their clocks differ, set clock: {other}"
            )


def windows(recording: Recording) -> list[Window]:
    """Return where the episodes of a recording begin and end."""
    return cut(recording.events, recording.first_ns, _ends(recording)[0][0])


def _ends(recording: Recording) -> list[tuple[int, Source]]:
    """Return the last times of the sources that stop when the recording stops, first one first.

    The others may be said once, as a goal or the pose of a fixed thing.
    """
    ends = [
        (int(source.series.times_ns[-1]), source)
        for source in recording.sources
        if source.stream.camera or source.stream.to in (STATE, "action")
    ]
    return sorted(ends, key=lambda end: end[0])


def rest_left_out(recording: Recording, window: Window) -> str:
    """Say which source stopped well before the others if that ended the window, else nothing."""
    ends = _ends(recording)
    stop, source = ends[0]
    after_ns = ends[-1][0] - max(stop, window.start_ns)
    usual_ns = longest_usual_gap_ns(usual_gap_ns(source.series))
    if not window.ended_by_source or after_ns <= usual_ns:
        return ""
    at_s = (stop - recording.first_ns) / NANOSECONDS
    return (
        f"{source.stream.name} stops at {at_s:.2f} s; {after_ns / NANOSECONDS:.2f} s after it "
        "left out"
    )


class Timeline:
    """The times of the rows within one window of a recording.

    Raises DataError if the rows would not fit into memory.
    """

    def __init__(self, recording: Recording, window: Window, period_ns: int) -> None:
        self._recording, self._window, self._period_ns = recording, window, period_ns
        self.ticks = self._ticks()
        """Times of the rows, (T + 1,) int64 ns; none if there is no action with all sources."""

    def _ticks(self) -> np.ndarray:
        times = self._recording.commands.times_ns
        ready = self._window.start_ns
        for source in self._recording.sources:
            first = int(source.series.times_ns[0])
            # The goal of an episode is often said in the same instant as its first action.
            ready = max(ready, first - (self._period_ns if source.stream.to == GOAL else 0))
        start = np.searchsorted(times, ready)
        if start == len(times) or times[start] > self._window.end_ns:
            return times[:0]
        # Rounded, for the last observation of a loop that jitters may come a little early.
        length_ns = self._window.end_ns - int(times[start])
        count = (length_ns + self._period_ns // 2) // self._period_ns + 1
        _check_size(self._recording, count)
        return int(times[start]) + self._period_ns * np.arange(count)

    def asked(self, source: Source, ticks: np.ndarray) -> np.ndarray:
        """Return the times at which ``source`` is looked up for the rows at ``ticks``.

        They are never beyond the episode's end.
        """
        if source.stream.to == GOAL and len(ticks):
            # What is said an instant after the first action still is the goal of the first row.
            ticks = np.maximum(ticks, self.ticks[0] + self._period_ns)
        return np.minimum(ticks, self._window.end_ns)

    def stretches(self) -> tuple[list[np.ndarray], int]:
        """Return the stretches that make an episode each, and how many rows are in none of them.

        A stretch is unbroken, at least two rows long, and has one goal; rows where a source is too
        old are in none. Neighbours that only the goal parts share an observation.
        """
        valid = np.ones(len(self.ticks), bool)
        for source in self._recording.sources:
            if source.stream.max_age_s and len(self.ticks):
                chosen = pick(source.series, self.asked(source, self.ticks), source.rule)
                age = np.abs(self.ticks - source.series.times_ns[chosen])
                valid &= age <= source.stream.max_age_s * NANOSECONDS
        edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(np.int8), [0]])))
        runs = [self.ticks[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
        parts = [part for run in runs if len(run) > 1 for part in self._split_by_goal(run)]
        return parts, int((~valid).sum())

    def _split_by_goal(self, ticks: np.ndarray) -> list[np.ndarray]:
        """Cut where the desired goal changes: a goal that changes starts a new episode."""
        goals = [s for s in self._recording.sources if s.stream.to == GOAL]
        if not goals:
            return [ticks]
        values = np.concatenate(
            [s.series.values[pick(s.series, self.asked(s, ticks), s.rule)] for s in goals],
            axis=1,
        )
        changed = np.flatnonzero(np.any(values[1:] != values[:-1], axis=1)) + 1
        edges = [0, *changed.tolist(), len(ticks) - 1]
        # Neighbours share an observation: the last one of the old goal is the first of the new.
        parts = [ticks[a : b + 1] for a, b in zip(edges[:-1], edges[1:], strict=True)]
        return [part for part in parts if len(part) > 1]


def _check_size(recording: Recording, rows: int) -> None:
    row = sum(8 * len(source.names) for source in recording.sources)
    row += sum(3 * s.image_size[0] * s.image_size[1] for s in recording.sources if s.image_size)
    if rows * row > MAX_EPISODE_BYTES:
        raise DataError(
            f"{recording.path}: an episode of {rows} rows would take {rows * row / 2**30:.1f} "
            f"GiB (limit {MAX_EPISODE_BYTES / 2**30:.0f}); cut it by events, give images a "
            "smaller size, or check the clocks"
        )
