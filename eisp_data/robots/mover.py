"""Carries out actions on a robot; an arm that presses too hard against something gives way."""

from __future__ import annotations

import numpy as np

from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.robot import JointCommand, Reading, Robot

_YIELD_SHARE = 0.6
"""Of a joint's greatest torque: more than any motion in the air takes."""
_MOST_N, _GONE_N = 60.0, 15.0
"""In training 60 N was the most that the gripper could push with. With less than the other there is
no contact any more;"""
_GENTLE_TICKS = 12
"""but for so long it comes near only slowly: it would strike again and again."""
_WEDGED_TICKS = 1
"""What has strained for so many ticks, although it was held back, is wedged."""
_STIFFNESS_N_M = 40e3
"""Of the arm's servos, at the tool: measured in the twin, pressing on a block."""


class Mover:
    """From actions to what was really sent.

    Attributes:
        servo: what turns the actions into joint targets.
    """

    def __init__(self, robot: Robot, servo: CartesianServo) -> None:
        """Take a connected robot; call ``start`` first."""
        self.servo = servo
        self._robot = robot
        self._sent: np.ndarray | None = None
        self._against: np.ndarray | None = None
        self._strained = self._gentle = 0

    def start(self) -> None:
        """Begin from an arm at rest."""
        self._sent = self._against = None
        self._strained = self._gentle = 0
        self.servo.start()

    def send(self, action: np.ndarray, reading: Reading) -> JointCommand:
        """Send the targets of one control period; return what was really sent.

        Args:
            action: (4,) in [-1, 1], see ``CartesianServo.step``.
            reading: the newest one.
        """
        if self._sent is None:
            self._sent = reading.joint_position
        wanted = self.servo.step(action, self._sent)
        if reading.joint_effort is not None:
            there = self._give_way(wanted.joint_position, self._sent, reading, reading.joint_effort)
            wanted = JointCommand(there, wanted.gripper_opening_m)
        command = self._robot.command(wanted)
        self._sent = command.joint_position
        return command

    def _give_way(
        self, wanted: np.ndarray, sent: np.ndarray, reading: Reading, effort: np.ndarray
    ) -> np.ndarray:
        """Return the targets (J,) rad that press with no more force than in training.

        What presses is held back in the direction of its force alone: an arm that took for its
        place where it was pressed to would wander off sideways, for it is not as stiff one way as
        another, and drag along what it presses on. One that is strained in spite of that is wedged,
        and gives way altogether.
        """
        here = reading.joint_position
        strained = bool((np.abs(effort) / self._robot.limits.effort).max() > _YIELD_SHARE)
        self._strained = self._strained + 1 if strained else 0
        if self._strained > _WEDGED_TICKS:
            return self.servo.give_way(here)
        if not strained and self._against is None:
            return wanted
        force = self.servo.force(here, effort)
        if strained:
            self._against = force / np.linalg.norm(force)
        assert self._against is not None
        pressing_n = float(force @ self._against)
        self._gentle = _GENTLE_TICKS if pressing_n > _GONE_N else self._gentle - 1
        if not self._gentle:
            self._against = None
            return wanted
        most_m = (_MOST_N - pressing_n) / _STIFFNESS_N_M
        if strained:
            pressed_m = self.servo.tool_in_task(sent) - self.servo.tool_in_task(here)
            most_m = -max(0.0, float(pressed_m @ self._against))
        return self.servo.held_back(wanted, sent, self._against, most_m)
