"""From the sources of a recording to Episodes at a fixed rate, with the age of every source.

Rows lie at ``first action + k / rate``; the first is the first action before which every source
has a sample. Row k holds what was known at its time and the command nearest to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from eisp_data.episode import Episode, Scalar
from eisp_data.errors import DataError
from eisp_data.storage.mcap.build import GOAL, STATE, build_episode, scale_action
from eisp_data.storage.mcap.collect import Clock, Source
from eisp_data.storage.mcap.mapping import EXTRA
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.resample import (
    NANOSECONDS,
    gaps,
    pick,
    resample,
    stands_in,
    usual_gap_ns,
)
from eisp_data.storage.mcap.sources import Recording, fetch_images
from eisp_data.storage.mcap.windows import Window, cut, dropped
from eisp_data.storage.schema import REPEATED

AGE = "age_s."
"""Columns with the age of each source; below 0 where the nearest sample came later."""
MAX_EPISODE_BYTES = 2 * 2**30
"""The most that one episode may hold in memory, its images included."""
SHORTEST_GAP_NS = NANOSECONDS // 5
"""A source is said to have a gap after five of its usual intervals, but not below this."""


@dataclass(frozen=True)
class Rate:
    """How rows are made."""

    rate_hz: int
    """Rows per second."""
    epsilon_m: float = 0.05
    """The norm of the goal error up to which the goal is met (the paper's Eq. 1)."""
    clock: Clock = "hardware"
    """Whose times count: the sensors' or the recorder's."""


@dataclass
class Made:
    """One episode with its further columns, and what there is to say of it."""

    episode: Episode
    extras: dict[str, np.ndarray]
    """Column to (T, width) float32."""
    lines: list[str] = field(default_factory=list)


def age_columns(sources: list[Source]) -> list[str]:
    """Return the name of the column with the age of each source, all different."""
    names: list[str] = []
    for source in sources:
        part = "" if source.stream.camera else f".{source.stream.to.split('.')[-1]}"
        name = f"{AGE}{source.stream.name}{part}"
        same = sum(other.split("#")[0] == name for other in names)
        names.append(f"{name}#{same + 1}" if same else name)
    return names


def extra_widths(recording: Recording) -> dict[str, int]:
    """Return the further columns of each row and their widths."""
    widths = dict.fromkeys(age_columns(recording.sources), 1)
    for source in recording.sources:
        if source.stream.to.startswith(EXTRA):
            name = source.stream.to.removeprefix(EXTRA)
            widths[name] = widths.get(name, 0) + len(source.names)
        elif source.stream.camera is not None:
            widths[REPEATED + source.stream.camera] = 1
    return {**widths, "intervention": 1}


class Assembler:
    """Makes the episodes of one file."""

    def __init__(self, log: McapLog, recording: Recording, rate: Rate, task: str) -> None:
        self.log, self.recording, self.rate, self.task = log, recording, rate, task
        self.period_ns = round(NANOSECONDS / rate.rate_hz)
        self.lines = [
            f"{log.path.name}: {topic}: {n} messages dropped while recording"
            for topic, n in dropped(recording.events).items()
        ]
        for source in recording.sources:
            self._check_clock(source)
            for reason, n in source.left_out.items():
                self.lines.append(
                    f"{log.path.name}: {source.stream.topic}: {n} samples {reason} left out"
                )

    def episodes(self, skip: int = 0) -> Iterator[Made | None]:
        """Yield each episode in turn, None for the first ``skip``, whose images are not read."""
        number = 0
        for window in self._windows():
            if window.outcome == "discard":
                self._say(window, "discarded by the operator")
                continue
            ticks = self._ticks(window)
            parts = [
                part
                for run in self._runs(window, ticks)
                for part in self._split_by_goal(window, run)
            ]
            if not parts:
                self._say(window, "no row has all sources; left out")
            for part in parts:
                ended = window.outcome == "success" and part[-1] == ticks[-1]
                yield None if number < skip else self._make(window, part, number, bool(ended))
                number += 1

    def _check_clock(self, source: Source) -> None:
        """Raise DataError if a source never overlaps the actions: its clock must be another."""
        commands = next(s for s in self.recording.sources if s.stream.to == "action").series
        first, last = source.series.times_ns[[0, -1]]
        # What is said once, like a goal or the pose of a fixed thing, may well come before.
        at_a_rate = source.stream.camera is not None or source.stream.to == STATE
        if first > commands.times_ns[-1] or (at_a_rate and last < commands.times_ns[0]):
            apart_s = (first - commands.times_ns[0]) / NANOSECONDS
            other = "log" if self.rate.clock == "hardware" else "hardware"
            raise DataError(
                f"{self.log.path}: {source.stream.topic} begins {apart_s:.6g} s after the actions "
                f"and never overlaps them; if their clocks differ, set clock: {other}"
            )

    def _say(self, window: Window, text: str) -> None:
        at = (window.start_ns - self._first_ns()) / NANOSECONDS
        self.lines.append(f"{self.log.path.name}: episode at {at:.2f} s: {text}")

    def _first_ns(self) -> int:
        return min(int(source.series.times_ns[0]) for source in self.recording.sources)

    def _windows(self) -> list[Window]:
        # These stop when the recording stops; a goal or a fixed thing's pose may be said once.
        ends = [
            int(s.series.times_ns[-1])
            for s in self.recording.sources
            if s.stream.camera or s.stream.to in (STATE, "action")
        ]
        return cut(self.recording.events, self._first_ns(), min(ends))

    def _ticks(self, window: Window) -> np.ndarray:
        """Return the times of the rows of an episode, (T + 1,) int64 ns; none if T would be 0."""
        commands = next(s for s in self.recording.sources if s.stream.to == "action")
        times = commands.series.times_ns
        ready = window.start_ns
        for source in self.recording.sources:
            first = int(source.series.times_ns[0])
            # The goal of an episode is often said in the same instant as its first action.
            ready = max(ready, first - (self.period_ns if source.stream.to == GOAL else 0))
        start = np.searchsorted(times, ready)
        if start == len(times) or times[start] > window.end_ns:
            return times[:0]
        # Rounded, for the last observation of a loop that jitters may come a little early.
        length_ns = window.end_ns - int(times[start])
        count = (length_ns + self.period_ns // 2) // self.period_ns + 1
        self._check_size(count)
        window.first_row_ns = int(times[start])
        return window.first_row_ns + self.period_ns * np.arange(count)

    def _runs(self, window: Window, ticks: np.ndarray) -> list[np.ndarray]:
        """Return the unbroken stretches of ``ticks`` in which no source is too old."""
        valid = np.ones(len(ticks), bool)
        for source in self.recording.sources:
            if source.stream.max_age_s and len(ticks):
                chosen = pick(source.series, self._asked(source, window, ticks), source.rule)
                age = np.abs(ticks - source.series.times_ns[chosen])
                valid &= age <= source.stream.max_age_s * NANOSECONDS
        if not valid.all():
            self._say(window, f"{int((~valid).sum())} rows with a source too old left out")
        edges = np.flatnonzero(np.diff(np.concatenate([[0], valid.astype(np.int8), [0]])))
        runs = [ticks[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return [run for run in runs if len(run) > 1]

    def _asked(self, source: Source, window: Window, ticks: np.ndarray) -> np.ndarray:
        """Return the times at which ``source`` is looked up, never beyond the episode's end."""
        if source.stream.to == GOAL:
            # What is said an instant after the first action still is the goal of the first row.
            ticks = np.maximum(ticks, window.first_row_ns + self.period_ns)
        return np.minimum(ticks, window.end_ns)

    def _split_by_goal(self, window: Window, ticks: np.ndarray) -> list[np.ndarray]:
        """Cut where the desired goal changes: a goal that changes starts a new episode."""
        goals = [s for s in self.recording.sources if s.stream.to == GOAL]
        if not goals:
            return [ticks]
        values = np.concatenate(
            [s.series.values[pick(s.series, self._asked(s, window, ticks), s.rule)] for s in goals],
            axis=1,
        )
        changed = np.flatnonzero(np.any(values[1:] != values[:-1], axis=1)) + 1
        edges = [0, *changed.tolist(), len(ticks) - 1]
        # Neighbours share an observation: the last one of the old goal is the first of the new.
        parts = [ticks[a : b + 1] for a, b in zip(edges[:-1], edges[1:], strict=True)]
        return [part for part in parts if len(part) > 1]

    def _check_size(self, rows: int) -> None:
        row = sum(8 * len(source.names) for source in self.recording.sources)
        row += sum(
            3 * s.image_size[0] * s.image_size[1] for s in self.recording.sources if s.image_size
        )
        if rows * row > MAX_EPISODE_BYTES:
            raise DataError(
                f"{self.log.path}: an episode of {rows} rows would take {rows * row / 2**30:.1f} "
                f"GiB (limit {MAX_EPISODE_BYTES / 2**30:.0f}); cut it by events, give images a "
                "smaller size, or check the clocks"
            )

    def _make(self, window: Window, ticks: np.ndarray, number: int, ended: bool) -> Made:
        columns: dict[str, list[np.ndarray]] = {}
        images: dict[str, np.ndarray] = {}
        extras: dict[str, np.ndarray] = {}
        gap_lines: list[str] = []
        repeat_lines: list[str] = []
        repeated = 0
        for source, age in zip(
            self.recording.sources, age_columns(self.recording.sources), strict=True
        ):
            asked = self._asked(source, window, ticks)
            limit = max(5 * usual_gap_ns(source.series), SHORTEST_GAP_NS)
            values, ages_s = resample(source.series, asked, source.rule, limit)
            ages_s += (ticks - asked) / NANOSECONDS
            extras[age] = ages_s[:-1, None].astype(np.float32)
            camera = source.stream.camera
            if camera is not None:
                chosen = pick(source.series, asked, source.rule)
                images[camera] = fetch_images(self.log, source, chosen, self.rate.clock)
                again = stands_in(source.series, source.lost_before, asked, source.rule)[:-1]
                extras[REPEATED + camera] = again[:, None].astype(np.float32)
                repeat_lines += self._repeat_lines(source, number, again)
                repeated += int(again.sum())
            else:
                if source.stream.to == "action":
                    values = scale_action(source.stream, values)
                columns.setdefault(source.stream.to, []).append(values)
            gap_lines += self._gap_lines(source, number, ticks, limit)
        joined = {to: np.concatenate(parts, axis=1) for to, parts in columns.items()}
        for to in [to for to in joined if to.startswith(EXTRA)]:
            extras[to.removeprefix(EXTRA)] = joined.pop(to)[:-1].astype(np.float32)
        extras["intervention"] = _during(window.interventions, ticks[:-1])
        info = self._info(window, ticks, number, len(gap_lines), repeated)
        episode = build_episode(joined, images, info, self.rate.epsilon_m, ended)
        return Made(episode, extras, gap_lines + repeat_lines)

    def _repeat_lines(self, source: Source, number: int, again: np.ndarray) -> list[str]:
        if not again.any():
            return []
        return [
            f"{self.log.path.name}: episode {number}: {source.stream.name}: {int(again.sum())} of "
            f"{len(again)} rows repeat a frame, for the next one was lost"
        ]

    def _gap_lines(
        self, source: Source, number: int, ticks: np.ndarray, limit_ns: int
    ) -> list[str]:
        if len(source.series.times_ns) < 3 or source.stream.to == GOAL:
            return []  # Said once, not at a rate.
        return [
            f"{self.log.path.name}: episode {number}: {source.stream.name}: no sample for "
            f"{(end - start) / NANOSECONDS:.2f} s, from "
            f"{(start - self._first_ns()) / NANOSECONDS:.2f} s on"
            for start, end in gaps(source.series, int(ticks[0]), int(ticks[-1]), limit_ns)
        ]

    def _info(
        self, window: Window, ticks: np.ndarray, number: int, gap_count: int, repeated: int
    ) -> dict[str, Scalar]:
        return {
            **window.details,
            "task": self.task,
            "source_file": self.log.path.name,
            "source_episode": number,
            "start_ns": int(ticks[0]),
            "outcome": window.outcome,
            "success_mark": window.marked_success,
            "complete": window.complete,
            "interventions": len(window.interventions),
            "gaps": gap_count,
            "repeated_frames": repeated,
            "goal": "recorded" if self._has_goal() else "last achieved",
        }

    def _has_goal(self) -> bool:
        return any(source.stream.to == GOAL for source in self.recording.sources)


def _during(stretches: list[tuple[int, int]], ticks: np.ndarray) -> np.ndarray:
    """Return (T, 1) float32: 1 in the rows that lie within one of the stretches."""
    inside = np.zeros(len(ticks), np.float32)
    for start, end in stretches:
        inside[(ticks >= start) & (ticks <= end)] = 1.0
    return inside[:, None]
