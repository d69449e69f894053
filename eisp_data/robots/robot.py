"""What every robot is to the rest of the project: joints and cameras in, joint targets out.

One clock: every stamp is in seconds of the robot's own clock, which ``now_s`` reads. The driver
converts what a device with a clock of its own (a camera, a controller) says. A loop at a fixed rate
calls ``wait_until``, never ``time.sleep``: a simulated robot may run on simulated time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np


@dataclass(frozen=True)
class CameraIntrinsics:
    """A pinhole camera with OpenCV's distortion; its frame is x right, y down, z forward."""

    width: int
    height: int
    matrix: np.ndarray
    """(3, 3), pixels."""
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(5))
    """(5,): k1, k2, p1, p2, k3."""


@dataclass(frozen=True)
class CameraFrame:
    """One image."""

    image: np.ndarray
    """(H, W, 3) uint8, RGB."""
    captured_s: float
    """When the light fell on the sensor, on the robot's clock."""
    sequence: int
    """Counts what the camera captured: a gap is a dropped frame."""


@dataclass(frozen=True)
class Reading:
    """What the joints say."""

    joint_position: np.ndarray
    """(J,) rad."""
    joint_velocity: np.ndarray
    """(J,) rad/s."""
    gripper_opening_m: float
    """Between the fingertips."""
    hardware_s: float
    """When this was measured, on the robot's clock."""
    joint_effort: np.ndarray | None = None
    """(J,) N m, None where the robot does not measure it."""


@dataclass(frozen=True)
class JointCommand:
    """Where the joints and the gripper should be one control period from now."""

    joint_position: np.ndarray
    """(J,) rad."""
    gripper_opening_m: float
    """Between the fingertips."""


@dataclass(frozen=True)
class JointLimits:
    """What the hardware can do; ``safety`` keeps within a share of it."""

    position_low: np.ndarray
    """(J,) rad."""
    position_high: np.ndarray
    """(J,) rad."""
    velocity: np.ndarray
    """(J,) rad/s."""
    acceleration: np.ndarray
    """(J,) rad/s^2."""
    effort: np.ndarray
    """(J,) N m."""
    gripper_m: tuple[float, float]
    """Closed and open, between the fingertips."""
    gripper_speed_m_s: float


class Robot(ABC):
    """An arm with a gripper and cameras; of its methods only ``stop`` may come from another thread.

    Attributes:
        name: as in the registry.
        arm: which kinematics it has, a name in ``arms.ARMS``.
        joint_names: J names, in the order of every array of joints.
        control_hz: the rate at which commands are expected.
        limits: of the joints and the gripper.
        cameras: the cameras by name; empty where there are none.
    """

    name: str
    arm: str
    joint_names: tuple[str, ...]
    control_hz: float
    limits: JointLimits
    cameras: Mapping[str, CameraIntrinsics]

    @abstractmethod
    def connect(self) -> None:
        """Open what is needed to observe and command; the robot stands still.

        Raises:
            RobotError: nothing answers, or what answers is not this robot.
        """

    def calibrate(self) -> None:  # noqa: B027 - most arms have nothing to do here
        """Make the readings right, where the hardware needs that after power-up."""

    @abstractmethod
    def now_s(self) -> float:
        """Read the robot's clock."""

    @abstractmethod
    def wait_until(self, robot_s: float) -> None:
        """Return when ``now_s`` has reached that time, at once if it has."""

    @abstractmethod
    def observe(self) -> Reading:
        """Return the newest reading without waiting for another.

        Raises:
            RobotError: the connection is lost.
        """

    @abstractmethod
    def frames(self) -> dict[str, CameraFrame]:
        """Return the newest frame of each camera that has one, without waiting for another.

        Raises:
            RobotError: a camera is unplugged.
        """

    @abstractmethod
    def command(self, command: JointCommand) -> JointCommand:
        """Move towards the targets; return what was really sent (in the device's own resolution).

        Raises:
            RobotError: the connection is lost, or the robot is in a protective stop.
        """

    @abstractmethod
    def stop(self) -> None:
        """Come to a stop as fast as is smooth, and stay. Safe to call twice, or unconnected."""

    @abstractmethod
    def disconnect(self) -> None:
        """Stop, and close what ``connect`` opened. Safe to call twice, or unconnected."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.disconnect()
