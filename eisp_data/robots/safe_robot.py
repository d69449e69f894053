"""A robot behind the safety filter: what recording and deployment command instead of the robot."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NoReturn, TypeVar

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.collision import CollisionChecker
from eisp_data.robots.robot import CameraFrame, JointCommand, Reading, Robot
from eisp_data.robots.safety import SafetyConfig, SafetyFilter

_Answer = TypeVar("_Answer")

_LATE_PERIODS = 2.5
"""After a pause this long the arm has arrived where it was sent and stands."""
_OVERLOAD_S = 0.2
"""A torque beyond the limit for so long: an arm that gains speed has one for an instant."""


class SafeRobot(Robot):
    """Any robot, with every command filtered and every fault ending in a standstill.

    Once stopped by a fault it stays stopped until it is connected anew.

    Attributes:
        filter: what is between; its ``refusals`` say what was changed, and how often.
    """

    def __init__(
        self,
        robot: Robot,
        config: SafetyConfig | None = None,
        transform_task_to_base: np.ndarray | None = None,
        dry_run: bool = False,
    ) -> None:
        """Put the filter before a robot that is not yet connected.

        Args:
            robot: what is to be protected.
            config: the default one if left out.
            transform_task_to_base: (4, 4) from a calibration; the arm's usual one if left out.
            dry_run: filter and return commands, but send none.
        """
        config = config or SafetyConfig()
        self._robot, self.dry_run = robot, dry_run
        self.name, self.arm, self.joint_names = robot.name, robot.arm, robot.joint_names
        self.control_hz, self.limits, self.cameras = robot.control_hz, robot.limits, robot.cameras
        collisions = None
        if config.check_collisions:
            collisions = CollisionChecker(robot.arm, transform_task_to_base)
        self.filter = SafetyFilter(
            robot.arm, robot.limits, robot.control_hz, config, transform_task_to_base, collisions
        )
        self._fault: str | None = "not connected"
        self._reading: Reading | None = None
        self._commanded_s: float | None = None
        self._eased_s = -np.inf

    def connect(self) -> None:
        """Connect, and see that the readings are sound."""
        self._robot.connect()
        # A camera may be known only now.
        self.cameras = self._robot.cameras
        self._fault = self._commanded_s = None
        self._eased_s = self._robot.now_s()
        self.observe()

    def calibrate(self) -> None:
        """As the robot does; in a dry run not at all, for the gripper may move."""
        if not self.dry_run:
            self._guarded(self._robot.calibrate)

    def now_s(self) -> float:
        """As the robot does."""
        return self._robot.now_s()

    def wait_until(self, robot_s: float) -> None:
        """As the robot does."""
        self._robot.wait_until(robot_s)

    def observe(self) -> Reading:
        """Return the newest reading; a lost connection, NaN or too high a torque stops the arm."""
        self._reading = self._guarded(self._robot.observe)
        fault = self._fault_in(self._reading)
        if fault:
            self._fail(fault)
        return self._reading

    def frames(self) -> dict[str, CameraFrame]:
        """Return the newest frames; an unplugged camera stops the arm."""
        return self._guarded(self._robot.frames)

    def command(self, command: JointCommand) -> JointCommand:
        """Send what of the command is allowed and return what was really sent.

        Raises:
            RobotError: the readings are stale, the arm does not follow, or a fault before.
        """
        self._raise_fault()
        now = self.now_s()
        reading = self._reading
        config = self.filter.config
        if reading is None or now - reading.hardware_s > config.stale_s:
            age = "none" if reading is None else f"{now - reading.hardware_s:.2f} s old"
            self._fail(f"the last reading is {age}; the limit is {config.stale_s:g} s")
        if self._commanded_s is None:
            self.filter.start(reading.joint_position, reading.gripper_opening_m)
        elif now - self._commanded_s > _LATE_PERIODS / self.control_hz:
            self.filter.rest()
        if not self.dry_run:
            self._check_following(reading)
        self._commanded_s = now
        allowed = self.filter.step(command)
        if self.dry_run:
            return allowed
        return self._guarded(lambda: self._robot.command(allowed))

    def stop(self) -> None:
        """Stop the arm; the next command begins anew from where it stands."""
        self._robot.stop()
        self._commanded_s = None

    def disconnect(self) -> None:
        """Stop, and close the robot; commands are refused until it is connected again."""
        self._fault = self._fault or "not connected"
        self._robot.disconnect()

    def _check_following(self, reading: Reading) -> None:
        behind = np.abs(reading.joint_position - self.filter.position)
        if behind.max() > self.filter.config.following_rad:
            joint = self.joint_names[int(behind.argmax())]
            self._fail(f"{joint} is {behind.max():.2f} rad behind its command")

    def _guarded(self, action: Callable[[], _Answer]) -> _Answer:
        """Return what the robot returns; its errors stop it first."""
        self._raise_fault()
        try:
            return action()
        except RobotError as error:
            self._fail(str(error), error)

    def _fault_in(self, reading: Reading) -> str | None:
        values = (reading.joint_position, reading.joint_velocity, reading.gripper_opening_m)
        if not all(np.isfinite(value).all() for value in values):
            return "a joint reading is not a number"
        if reading.joint_effort is not None:
            share = np.abs(reading.joint_effort) / self.limits.effort
            if share.max() <= self.filter.config.effort_share:
                self._eased_s = reading.hardware_s
            elif not reading.hardware_s - self._eased_s <= _OVERLOAD_S:
                joint = self.joint_names[int(np.nanargmax(share))]
                return f"the torque of {joint} is {share.max():.0%} of its limit"
        return None

    def _fail(self, fault: str, cause: RobotError | None = None) -> NoReturn:
        """Stop the arm and raise; every later call raises the same."""
        self._fault = fault
        with contextlib.suppress(RobotError):
            self._robot.stop()
        raise RobotError(f"{fault}: {self.name} is stopped") from cause

    def _raise_fault(self) -> None:
        if self._fault:
            raise RobotError(f"{self._fault}: {self.name} is stopped")
