"""From the sources of a recording to Episodes, with the age of every source in each row.

Row k holds what was known at its time (see ``timeline``) and the command nearest to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from eisp_data.episode import Episode, Scalar
from eisp_data.errors import DataError
from eisp_data.storage.mcap import timeline
from eisp_data.storage.mcap.build import GOAL, build_episode, scale_action
from eisp_data.storage.mcap.collect import Clock, Source
from eisp_data.storage.mcap.columns import age_columns
from eisp_data.storage.mcap.mapping import EXTRA
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.resample import (
    NANOSECONDS,
    gaps,
    longest_usual_gap_ns,
    pick,
    resample,
    stands_in,
    usual_gap_ns,
)
from eisp_data.storage.mcap.sources import Recording, fetch_images
from eisp_data.storage.mcap.windows import Window, dropped, started, unknown_words
from eisp_data.storage.schema import INTERVENTION, REPEATED


@dataclass(frozen=True)
class Rate:
    """How rows are made."""

    rate_hz: int
    """Rows per second."""
    epsilon_m: float = 0.05
    """The norm of the goal error up to which the goal is met (the paper's Eq. 1)."""
    clock: Clock = "hardware"
    """Whose times count: the sensors' or the recorder's."""


ORIGIN = ("source_file", "source_episode", "start_ns")
"""What an episode's info says of where it is from; files in different folders may share a name."""
Origin = tuple[Scalar | None, ...]


@dataclass
class Made:
    """One episode with its further columns, and what there is to say of it."""

    episode: Episode
    extras: dict[str, np.ndarray]
    """Column to (T, width) float32."""
    lines: list[str] = field(default_factory=list)


class Assembler:
    """Makes the episodes of one file."""

    def __init__(self, log: McapLog, recording: Recording, rate: Rate, task: str) -> None:
        """Raise DataError if the clocks of the sources cannot be the same, or if none of the events
        is understood: all would be one episode, with what lay between them."""
        timeline.check_clocks(recording, rate.clock)
        self.log, self.recording, self.rate, self.task = log, recording, rate, task
        self._file = recording.path.name
        self.lines = [
            f"{self._file}: {topic}: {n} messages dropped while recording"
            for topic, n in dropped(recording.events).items()
        ]
        if unknown := unknown_words(recording.events):
            if not started(recording.events):
                raise DataError(f"{recording.path}: {unknown}")
            self.lines.append(f"{self._file}: {unknown}")
        self.lines += [
            f"{self._file}: {source.stream.topic}: {n} samples {reason} left out"
            for source in recording.sources
            for reason, n in source.left_out.items()
        ]

    def episodes(self, done: Counter[Origin]) -> Iterator[Made]:
        """Yield each episode in turn but those of ``done``, which are taken out of it."""
        number = 0
        period_ns = round(NANOSECONDS / self.rate.rate_hz)
        for window in timeline.windows(self.recording):
            if window.outcome == "discard":
                self._say(window, "discarded by the operator")
                continue
            if rest := timeline.rest_left_out(self.recording, window):
                self._say(window, rest)
            rows = timeline.Timeline(self.recording, window, period_ns)
            stretches, left_out = rows.stretches()
            if left_out:
                self._say(window, f"{left_out} rows with a source too old left out")
            if not stretches:
                self._say(window, "no row has all sources; left out")
            for ticks in stretches:
                ended = window.outcome == "success" and bool(ticks[-1] == rows.ticks[-1])
                here = (self._file, number, int(ticks[0]))
                if done[here]:
                    done[here] -= 1
                else:
                    yield self._make(window, rows, ticks, number, ended)
                number += 1

    def _say(self, window: Window, text: str) -> None:
        at = (window.start_ns - self.recording.first_ns) / NANOSECONDS
        self.lines.append(f"{self._file}: episode at {at:.2f} s: {text}")

    def _make(
        self,
        window: Window,
        rows: timeline.Timeline,
        ticks: np.ndarray,
        number: int,
        ended: bool,
    ) -> Made:
        columns: dict[str, list[np.ndarray]] = {}
        images: dict[str, np.ndarray] = {}
        extras: dict[str, np.ndarray] = {}
        gap_lines: list[str] = []
        repeat_lines: list[str] = []
        repeated = 0
        sources = self.recording.sources
        for source, age in zip(sources, age_columns(sources), strict=True):
            asked = rows.asked(source, ticks)
            limit = longest_usual_gap_ns(usual_gap_ns(source.series))
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
        extras[INTERVENTION] = _during(window.interventions, ticks[:-1])
        info = self._info(window, ticks, number, len(gap_lines), repeated)
        episode = build_episode(joined, images, info, self.rate.epsilon_m, ended)
        return Made(episode, extras, gap_lines + repeat_lines)

    def _repeat_lines(self, source: Source, number: int, again: np.ndarray) -> list[str]:
        if not again.any():
            return []
        return [
            f"{self._file}: episode {number}: {source.stream.name}: {int(again.sum())} of "
            f"{len(again)} rows repeat a frame, for the next one was lost"
        ]

    def _gap_lines(
        self, source: Source, number: int, ticks: np.ndarray, limit_ns: int
    ) -> list[str]:
        if len(source.series.times_ns) < 3 or source.stream.to == GOAL:
            return []  # Said once, not at a rate.
        return [
            f"{self._file}: episode {number}: {source.stream.name}: no sample for "
            f"{(end - start) / NANOSECONDS:.2f} s, from "
            f"{(start - self.recording.first_ns) / NANOSECONDS:.2f} s on"
            for start, end in gaps(source.series, int(ticks[0]), int(ticks[-1]), limit_ns)
        ]

    def _info(
        self, window: Window, ticks: np.ndarray, number: int, gap_count: int, repeated: int
    ) -> dict[str, Scalar]:
        has_goal = any(source.stream.to == GOAL for source in self.recording.sources)
        return {
            **window.details,
            "task": self.task,
            "source_file": self._file,
            "source_episode": number,
            "start_ns": int(ticks[0]),
            "outcome": window.outcome,
            "success_mark": window.marked_success,
            "complete": window.complete,
            "interventions": len(window.interventions),
            "gaps": gap_count,
            "repeated_frames": repeated,
            "goal": "recorded" if has_goal else "last achieved",
        }


def _during(stretches: list[tuple[int, int]], ticks: np.ndarray) -> np.ndarray:
    """Return (T, 1) float32: 1 in the rows from a stretch's start until before its end."""
    inside = np.zeros(len(ticks), np.float32)
    for start, end in stretches:
        inside[(ticks >= start) & (ticks < end)] = 1.0
    return inside[:, None]
