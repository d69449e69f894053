"""Carries out actions on a robot; an arm that presses too hard against something gives way."""

from __future__ import annotations

import numpy as np

from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.robot import JointCommand, Reading, Robot

_YIELD_SHARE = 0.6
"""Of a joint's greatest torque. In training 60 N was the most that the gripper could push with."""


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

    def start(self) -> None:
        """Begin from an arm at rest."""
        self._sent = None
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
            share = np.abs(reading.joint_effort) / self._robot.limits.effort
            if share.max() > _YIELD_SHARE:
                there = self.servo.give_way(reading.joint_position)
                wanted = JointCommand(there, wanted.gripper_opening_m)
        command = self._robot.command(wanted)
        self._sent = command.joint_position
        return command
