"""Which episodes of a dataset are learned from and which are held out, and their rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.cache import DatasetArrays

_GOLDEN_RATIO = (5.0**0.5 - 1.0) / 2.0
"""Its multiples, modulo one, fill [0, 1) evenly however many are taken (Weyl)."""
_ROUNDING = 1e-12


def rows_of(arrays: DatasetArrays, episodes: np.ndarray) -> np.ndarray:
    """Return the rows of the named episodes."""
    starts, stops = arrays.episode_start[episodes], arrays.episode_start[episodes + 1]
    return np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])


def split(episodes: int, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the episodes that are held out, at least one, and of the others.

    Whether an episode is held out does not depend on how many others there are, so that a dataset
    that has grown does not bring what was held out before into the training.
    """
    place = (np.random.default_rng(seed).random() + _GOLDEN_RATIO * np.arange(episodes)) % 1.0
    held = place < max(share, place.min() + _ROUNDING)
    return np.flatnonzero(held), np.flatnonzero(~held)


def hold_out(
    root: Path, arrays: DatasetArrays, share: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``split`` of a dataset; DataError if nothing is left to learn from."""
    held, rest = split(arrays.num_episodes, share, seed)
    if not len(rest):
        raise DataError(f"{root} has too few episodes: {arrays.num_episodes}")
    return held, rest
