"""Which episodes of a dataset are learned from and which are held out, and their rows."""

from __future__ import annotations

import numpy as np

from eisp_data.storage.cache import DatasetArrays


def rows_of(arrays: DatasetArrays, episodes: np.ndarray) -> np.ndarray:
    """Return the rows of the named episodes."""
    starts, stops = arrays.episode_start[episodes], arrays.episode_start[episodes + 1]
    return np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])


def split(episodes: int, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the episodes that are held out, and of the others, each in order."""
    order = np.random.default_rng(seed).permutation(episodes)
    held = max(1, round(share * episodes))
    return np.sort(order[:held]), np.sort(order[held:])
