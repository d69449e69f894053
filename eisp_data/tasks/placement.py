"""Random places on the table that keep their distance."""

from __future__ import annotations

import numpy as np

TABLE_LOW_M = (0.22, -0.16)
TABLE_HIGH_M = (0.40, 0.16)
"""Where blocks and goals lie: the workspace less room for the gripper on every side."""


def scatter(
    rng: np.random.Generator,
    count: int,
    separation_m: float,
    low: tuple[float, float] = TABLE_LOW_M,
    high: tuple[float, float] = TABLE_HIGH_M,
    taken: np.ndarray | None = None,
) -> np.ndarray:
    """Draw points uniformly until all keep their distance from each other and from those taken.

    Args:
        rng: the world's generator.
        count: how many points.
        separation_m: least distance between any two.
        low: (x, y) of the near right corner.
        high: (x, y) of the far left corner.
        taken: (M, 2) points to keep away from.

    Returns:
        (count, 2) metres.
    """
    fixed = np.empty((0, 2)) if taken is None else np.asarray(taken)
    while True:
        points = fixed
        for _ in range(50 * count):
            point = rng.uniform(low, high)
            if (np.linalg.norm(points - point, axis=1) >= separation_m).all():
                points = np.vstack([points, point])
                if len(points) == len(fixed) + count:
                    return points[len(fixed) :]
