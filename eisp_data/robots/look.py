"""Out of the camera's way, a look at the table, and back: before an episode and between subgoals.

The paper: "the robot arm is reset to a specific pose to observe the current state after achieving
each subgoal".
"""

from __future__ import annotations

import numpy as np

from eisp_data.sim.scene import FINGER_TRAVEL_M
from eisp_data.tasks.base import ACTION_SCALE_M

LOOK_FROM_M = (0.22, 0.0, 0.26)
"""Where the gripper waits while the camera, opposite the arm, sees the table; task's frame."""
_READY_M = (0.29, 0.0, 0.17)
"""Where it goes on from: among the places at which episodes begin in training."""
FRESH_S = 0.15
"""What was seen so lately is in sight."""

_SPEED = 0.25
"""Of the fastest displacement."""
_UP_M = 0.08
"""It first rises by this, so that nothing is knocked over."""
_NEAR_M = 0.02
_LONGEST_LEG_TICKS = 80
_LONGEST_WAIT_TICKS = 75
_OPEN_M = 0.06
_LONGEST_OPENING_TICKS = 25


def opening_action(opening_m: float) -> float:
    """Return the fourth action that leaves the fingers where they are."""
    return float(np.clip(opening_m / FINGER_TRAVEL_M - 1.0, -1.0, 1.0))


class Look:
    """Leads the gripper up, out of the camera's way and, once all is seen, back over the table."""

    def __init__(self, gripper_m: np.ndarray, opens: bool, holds: bool) -> None:
        """Begin.

        Args:
            gripper_m: (3,) m, task's frame.
            opens: the fingers are to be open at the end; if not they stay as they are.
            holds: there is something between them, which is let go of before anything.
        """
        x, y, z = gripper_m
        up = np.array([x, y, max(z + _UP_M, LOOK_FROM_M[2])])
        self._legs = [up, np.array(LOOK_FROM_M), np.array(_READY_M)]
        self._opens, self._holds = opens, holds
        self._ticks = 0
        """Of this leg."""

    def step(self, gripper_m: np.ndarray, opening_m: float, sees_all: bool) -> np.ndarray | None:
        """Return the action (4,) of this tick, None once the look is over.

        Args:
            gripper_m: (3,) m.
            opening_m: between the fingertips.
            sees_all: everything on the table is in sight.
        """
        self._ticks += 1
        if self._holds and opening_m < _OPEN_M and self._ticks < _LONGEST_OPENING_TICKS:
            return np.array([0.0, 0.0, 0.0, 1.0])
        # Fingers that open beside a block would push it away.
        rises = len(self._legs) == 3
        opens = self._holds or (self._opens and not rises)
        fingers = 1.0 if opens else opening_action(opening_m)
        way = self._legs[0] - gripper_m
        # What keeps the arm from getting there shall not keep it for ever.
        there = np.linalg.norm(way) < _NEAR_M or self._ticks > _LONGEST_LEG_TICKS
        looks = len(self._legs) == 2
        waits = looks and not sees_all and self._ticks < _LONGEST_LEG_TICKS + _LONGEST_WAIT_TICKS
        if there and not waits:
            del self._legs[0]
            self._ticks = 0
            if not self._legs:
                return None
            way = self._legs[0] - gripper_m
        return np.append(np.clip(way / ACTION_SCALE_M, -_SPEED, _SPEED), fingers)
