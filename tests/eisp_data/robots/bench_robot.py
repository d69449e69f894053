"""A robot in memory, on simulated time: its joints are where they were told to be."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.arms import joint_limits
from eisp_data.robots.calibration import usual
from eisp_data.robots.cell import HOME_RAD
from eisp_data.robots.robot import CameraFrame, CameraIntrinsics, JointCommand, Reading, Robot

CAMERA_HZ = 30.0
READING_HZ = 100.0


class BenchRobot(Robot):
    """Reads its joints 100 times a second; its camera takes 30 images a second, every tenth lost.

    Attributes:
        standing: whether it was stopped after the last command.
        sent: all commands.
        unplugged_after_s: from when on the camera does not answer.
    """

    name, arm, control_hz = "bench", "ur3", 25.0
    unplugs_after_s = float("inf")
    """Of the robots made from now on."""
    presses = 0.0
    """Share of the greatest torque that every joint of theirs reads."""
    made: ClassVar[list[BenchRobot]] = []

    def __init__(self, host: str = "", camera: str | None = None) -> None:
        self.made.append(self)
        self.limits = joint_limits("ur3")
        self.joint_names = tuple(f"joint_{i}" for i in range(6))
        self.cameras = {"top": CameraIntrinsics(64, 48, np.eye(3))}
        self.calibration = usual(self)
        self._now_s, self._joints, self._opening = 10.0, np.array(HOME_RAD), 0.08
        self.connected, self.standing = False, True
        self.sent: list[JointCommand] = []
        self.unplugged_after_s = self.unplugs_after_s

    def connect(self) -> None:
        self.connected = True

    def now_s(self) -> float:
        return self._now_s

    def wait_until(self, robot_s: float) -> None:
        self._now_s = max(self._now_s, robot_s)

    def observe(self) -> Reading:
        at = np.floor(self._now_s * READING_HZ + 1e-6) / READING_HZ
        effort = self.presses * self.limits.effort
        return Reading(self._joints.copy(), np.zeros(6), self._opening, float(at), effort)

    def frames(self) -> dict[str, CameraFrame]:
        if self._now_s > self.unplugged_after_s:
            raise RobotError("camera 'top' is unplugged")
        number = int(self._now_s * CAMERA_HZ + 1e-6)
        number -= number % 10 == 0
        image = np.full((48, 64, 3), number % 256, np.uint8)
        return {"top": CameraFrame(image, number / CAMERA_HZ, number)}

    def command(self, command: JointCommand) -> JointCommand:
        self.standing = False
        self._joints, self._opening = command.joint_position, command.gripper_opening_m
        self.sent.append(command)
        return command

    def stop(self) -> None:
        self.standing = True

    def disconnect(self) -> None:
        self.stop()
        self.connected = False
