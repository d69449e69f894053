"""Where a block is that was let go of in motion, until it stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Fall:
    """A throw, mostly a small one: the arm that lets go is on its way up already."""

    start: np.ndarray
    """(4, 4) pose to the task when it was let go of."""
    velocity: np.ndarray
    """(3,) m/s then."""
    start_s: float
    floor_m: float
    """Height of the block's centre once it stands."""

    @property
    def landed_s(self) -> float:
        """When it stands."""
        above, upwards = self.start[2, 3] - self.floor_m, self.velocity[2]
        root = np.sqrt(max(upwards**2 + 2 * _GRAVITY_M_S2 * above, 0.0))
        return self.start_s + max(0.0, float(upwards + root) / _GRAVITY_M_S2)

    def pose(self, time_s: float) -> np.ndarray:
        """Return the block's (4, 4) pose to the task."""
        passed = min(time_s, self.landed_s) - self.start_s
        pose = self.start.copy()
        pose[:3, 3] += passed * self.velocity
        pose[2, 3] -= _GRAVITY_M_S2 * passed**2 / 2
        if time_s >= self.landed_s:
            pose[2, 3] = self.floor_m
        return pose
