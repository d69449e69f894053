"""From samples at their own times to the values at a fixed rate, by a stated rule.

Worked example, samples at 0, 40 and 130 ms, a row at 100 ms:

=============  ==============================  ======
rule           value                           age
=============  ==============================  ======
hold           that of 40 ms                   60 ms
nearest        that of 130 ms                  -30 ms
interpolate    1/3 of the first, 2/3 of the    60 ms
               other (60 of 90 ms have gone)
=============  ==============================  ======
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NANOSECONDS = 1_000_000_000
_SHORTEST_GAP_NS = NANOSECONDS // 5
_EARLY = 0.25
"""Of an interval: how much less than two of them still means that a sample was lost."""


@dataclass(frozen=True)
class Series:
    """The samples of one source, in the order of their times."""

    times_ns: np.ndarray
    """(N,) int64, strictly rising."""
    values: np.ndarray
    """(N, D) float64; (N, 0) for a source of images, which are fetched later."""
    quaternions: tuple[int, ...] = ()
    """Columns at which a quaternion (wxyz) begins."""


def make_series(
    times_ns: np.ndarray, values: np.ndarray, quaternions: tuple[int, ...] = ()
) -> Series:
    """Sort samples by time; of several at one time, the last one recorded counts."""
    order = np.argsort(times_ns, kind="stable")
    times_ns, values = times_ns[order], values[order]
    last = np.append(times_ns[1:] != times_ns[:-1], True) if len(times_ns) else np.zeros(0, bool)
    return Series(times_ns[last], values[last], quaternions)


def pick(series: Series, ticks_ns: np.ndarray, rule: str) -> np.ndarray:
    """Return (K,) int64: the sample that counts as the source of each row, -1 if there is none.

    For interpolate that is the earlier neighbour, as for hold.
    """
    before = np.searchsorted(series.times_ns, ticks_ns, side="right") - 1
    if rule != "nearest":
        return before
    after = np.minimum(before + 1, len(series.times_ns) - 1)
    earlier = np.maximum(before, 0)
    closer = np.abs(series.times_ns[after] - ticks_ns) < np.abs(series.times_ns[earlier] - ticks_ns)
    return np.where(closer, after, earlier)


def resample(
    series: Series, ticks_ns: np.ndarray, rule: str, max_gap_ns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (K, D) float64 and their ages in seconds (K,) float64 at the K ticks.

    Each tick must have a source (see ``pick``). Neighbours further apart than ``max_gap_ns`` are
    not interpolated, the earlier one is held: no motion is made up where nothing was recorded.
    """
    source = pick(series, ticks_ns, rule)
    ages_s = (ticks_ns - series.times_ns[source]) / NANOSECONDS
    values = series.values[source].copy()
    if rule == "interpolate":
        after = np.minimum(source + 1, len(series.times_ns) - 1)
        gap = series.times_ns[after] - series.times_ns[source]
        inside = (gap > 0) & (gap <= max_gap_ns)
        part = np.where(inside, (ticks_ns - series.times_ns[source]) / np.where(inside, gap, 1), 0)
        end = series.values[after]
        values += part[:, None] * (end - values)
        for column in series.quaternions:
            block = slice(column, column + 4)
            values[:, block] = slerp(series.values[source][:, block], end[:, block], part)
    return values, ages_s


def slerp(start: np.ndarray, end: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Turn from ``start`` towards ``end`` (N, 4, unit, wxyz) by ``part`` (N,), the short way."""
    dot = np.sum(start * end, axis=-1)
    end = np.where(dot[:, None] < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    # Where the two all but agree the formula is 0 / 0; a straight line does as well there.
    near = sine < 1e-9
    sine = np.where(near, 1.0, sine)
    first = np.where(near, 1 - part, np.sin((1 - part) * angle) / sine)
    second = np.where(near, part, np.sin(part * angle) / sine)
    turned = first[:, None] * start + second[:, None] * end
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def gaps(series: Series, start_ns: int, end_ns: int, limit_ns: int) -> list[tuple[int, int]]:
    """Return (from, to) of each stretch within the window that has no sample for too long.

    The window's own ends count: a camera that is unplugged leaves a gap up to the end.
    """
    inside = series.times_ns[(series.times_ns > start_ns) & (series.times_ns < end_ns)]
    edges = np.concatenate([[start_ns], inside, [end_ns]])
    long = np.flatnonzero(np.diff(edges) > limit_ns)
    return [(int(edges[i]), int(edges[i + 1])) for i in long]


def stands_in(
    series: Series, lost_before: np.ndarray, ticks_ns: np.ndarray, rule: str
) -> np.ndarray:
    """Return (K,) bool: rows whose sample stands in for one that was lost.

    Samples are lost where their sequence numbers say so, and where a source that sends at a steady
    rate has a gap; they are taken to lie evenly in it. Worked example: of frames every 40 ms that
    of 80 ms is lost. Held rows at 79, 80, 119 and 120 ms give False, True, True, False.

    Args:
        series: the samples.
        lost_before: (N,) int64, see ``collect.lost_before``.
        ticks_ns: (K,) int64 times of the rows, rising, none before the first sample.
        rule: hold or nearest.
    """
    usual = usual_gap_ns(series)
    before = np.searchsorted(series.times_ns, ticks_ns, side="right") - 1
    after = np.minimum(before + 1, len(series.times_ns) - 1)
    since = ticks_ns - series.times_ns[before]
    gap = series.times_ns[after] - series.times_ns[before]
    lost = lost_before[after].astype(np.float64)
    if usual:
        lost = np.maximum(lost, np.floor(gap / usual + _EARLY) - 1)
    passed = since * (lost + 1) / np.maximum(gap, 1)
    place = np.round(passed) if rule == "nearest" else np.floor(passed)
    # After the last sample there is no gap, but silence up to the last row.
    silent = usual > 0 and ticks_ns[-1] - series.times_ns[-1] >= (2 - _EARLY) * usual
    return np.where(before == after, silent & (since >= usual), (place >= 1) & (place <= lost))


def usual_gap_ns(series: Series) -> int:
    """Return the median time between samples; 0 with fewer than two."""
    return int(np.median(np.diff(series.times_ns))) if len(series.times_ns) > 1 else 0


def longest_usual_gap_ns(usual_ns: int) -> int:
    """Return how long a source may be silent before that is a gap: five usual intervals, or more.

    Five intervals of a fast source are still no gap below 0.2 s.
    """
    return max(5 * usual_ns, _SHORTEST_GAP_NS)
