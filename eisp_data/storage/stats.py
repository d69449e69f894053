"""Statistics of episodes, in the form LeRobot keeps them.

Per episode: minimum, maximum, mean, standard deviation and five quantiles of every numeric
column, exact. Over a dataset: the first four are exact; a quantile is the mean of the episodes'
quantiles weighted by their rows, LeRobot's own rule, so that its tools and ours agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats = dict[str, np.ndarray]


def column_stats(episodes: Sequence[np.ndarray]) -> list[Stats]:
    """Return the statistics of one column of several episodes.

    Args:
        episodes: each episode's (T,) or (T, D) numbers or booleans, finite, D alike in all.

    Returns:
        Per episode ``min, max, mean, std, q01 … q99``: (D,) float64 each; ``count``: (1,) int64.
    """
    tables = [values.reshape(len(values), -1) for values in episodes]
    stats: list[Stats] = [{} for _ in tables]
    # Episodes of one length are worked out together: the calls cost more than the arithmetic.
    for length in {len(table) for table in tables}:
        chosen = [number for number, table in enumerate(tables) if len(table) == length]
        together = _stats_of_stack(np.stack([tables[number] for number in chosen]))
        for place, number in enumerate(chosen):
            own = {name: values[place] for name, values in together.items()}
            stats[number] = {**own, "count": np.array([length], dtype=np.int64)}
    return stats


def _stats_of_stack(stack: np.ndarray) -> Stats:
    """Return (E, D) statistics of (E, T, D) values."""
    if stack.dtype == np.bool_:
        stack = stack.astype(np.float32)
    # Components contiguous, so that numpy's vectorised sort runs over each.
    ordered = np.ascontiguousarray(stack.swapaxes(1, 2))
    ordered.sort(axis=2)
    mean = ordered.mean(axis=2, dtype=np.float64)
    stats: Stats = {
        "min": ordered[..., 0].astype(np.float64),
        "max": ordered[..., -1].astype(np.float64),
        "mean": mean,
        "std": ordered.std(axis=2, dtype=np.float64),
    }
    for name, quantile in QUANTILES.items():
        position = quantile * (ordered.shape[2] - 1)
        below = int(position)
        low = ordered[..., below].astype(np.float64)
        high = ordered[..., min(below + 1, ordered.shape[2] - 1)]
        stats[name] = low + (position - below) * (high - low)
    return stats


def image_stats(frames: np.ndarray, samples: int = 100) -> Stats:
    """Return the statistics of an episode's frames per channel, with values in [0, 1].

    Args:
        frames: (T, H, W, 3) uint8.
        samples: about how many frames, evenly spaced, are looked at.

    Returns:
        (3, 1, 1) float64 each; ``count``: (1,) int64, the number of frames looked at.
    """
    rows = np.unique(np.linspace(0, len(frames) - 1, min(samples, len(frames))).round().astype(int))
    stride = max(1, max(frames.shape[1:3]) // 150)
    chosen = frames[rows][:, ::stride, ::stride]
    levels = np.arange(256) / 255.0
    per_channel: dict[str, list[float]] = {}
    for channel in range(3):
        histogram = np.bincount(chosen[..., channel].reshape(-1), minlength=256)
        cumulative = np.cumsum(histogram)
        total = cumulative[-1]
        mean = float((histogram * levels).sum() / total)
        present = np.flatnonzero(histogram)
        values = {
            "min": levels[present[0]],
            "max": levels[present[-1]],
            "mean": mean,
            "std": float(np.sqrt((histogram * (levels - mean) ** 2).sum() / total)),
            **{n: levels[np.searchsorted(cumulative, q * total)] for n, q in QUANTILES.items()},
        }
        for name, value in values.items():
            per_channel.setdefault(name, []).append(value)
    stats: Stats = {name: np.array(value).reshape(3, 1, 1) for name, value in per_channel.items()}
    stats["count"] = np.array([len(rows)], dtype=np.int64)
    return stats


def aggregate(parts: Sequence[Mapping[str, np.ndarray]]) -> Stats:
    """Combine the statistics of one column over episodes, or over earlier combinations."""
    counts = np.array([float(part["count"][0]) for part in parts])
    total = counts.sum()

    def weighted(values: np.ndarray) -> np.ndarray:
        return np.tensordot(counts, values, axes=1) / total

    mean = weighted(np.stack([part["mean"] for part in parts]))
    spread = np.stack([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(weighted(spread)),
        **{name: weighted(np.stack([part[name] for part in parts])) for name in QUANTILES},
        "count": np.array([int(total)], dtype=np.int64),
    }
