"""Whether a block can slide straight from here to there between other blocks."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.scene import BLOCK_SIZE_M

WAY_HALF_WIDTH_M = BLOCK_SIZE_M + 0.004
"""Two upright blocks pass each other when their centres are this far apart along x or y."""


def on_the_way(
    start: np.ndarray,
    end: np.ndarray,
    others: np.ndarray,
    half_m: float | np.ndarray = WAY_HALF_WIDTH_M,
) -> np.ndarray:
    """Return which squares the straight segment from start to end enters.

    Args:
        start: (..., 2) metres.
        end: (..., 2) metres.
        others: (..., 2) metres, the centres of squares of 2 * half_m, broadcast with the segments.
        half_m: half the edge of a square, or (..., 1) of each; the sum of two half widths asks
            about two bodies.

    Returns:
        (...) bool.
    """
    way = end - start
    way = np.where(np.abs(way) < 1e-9, 1e-9, way)
    first = (others - half_m - start) / way
    second = (others + half_m - start) / way
    enter = np.minimum(first, second).max(axis=-1)
    leave = np.maximum(first, second).min(axis=-1)
    return np.maximum(enter, 0.0) < np.minimum(leave, 1.0)
