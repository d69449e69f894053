"""A robot, its camera and its table as one command line names them, connected and checked."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eisp_data.errors import ConfigError, RobotError
from eisp_data.robots.robot_config import RobotConfig, choose_camera, make_configured

if TYPE_CHECKING:
    from eisp_data.robots.calibration import Calibration
    from eisp_data.robots.motion import CartesianServo
    from eisp_data.robots.robot import Robot
    from eisp_data.robots.safe_robot import SafeRobot
    from eisp_data.robots.session_view import Eyes
    from eisp_data.robots.twin.referee import Referee
    from eisp_data.tasks.base import Task

_SLACK_M = 0.03
"""Objects may lie this far outside of where the gripper's middle may go."""
_FIRST_IMAGE_S, _ASK_AGAIN_S = 5.0, 0.02


@dataclass(frozen=True, kw_only=True)
class CellConfig(RobotConfig):
    """Which robot, before which table."""

    task: str | None = None
    """stack, push4, open_drawer or store; left out, nothing is looked for on the table."""
    calibration: Path | None = None
    """Calibration file of the cell; the twin has one of its own."""
    realtime: bool = True
    """Whether the twin runs on the wall's time; if not, as fast as it can."""
    seed: int = 0
    """Of goals, of the twin's table, and of scripts: episode i has seed + i."""
    goal: tuple[float, ...] | None = None
    """Where the objects belong: x, y, z in m for each, in the task's frame. Left out, a goal is
    drawn as in training."""
    dry_run: bool = False
    """Do everything but move: no command is sent."""


@dataclass(frozen=True)
class Cell:
    """A connected robot with what belongs to it."""

    robot: SafeRobot
    task: Task | None
    calibration: Calibration
    camera: str | None
    bare: Robot
    """The robot without the safety filter; a twin has its referee there."""

    @property
    def has_referee(self) -> bool:
        """Whether somebody knows the truth: of a twin only."""
        return hasattr(self.bare, "referee")

    @property
    def referee(self) -> Referee:
        """The twin's; for whoever sets the table or judges, not for who acts."""
        return self.bare.referee  # type: ignore[attr-defined]

    def eyes(self) -> Eyes:
        """Return what keeps track of the table."""
        from eisp_data.robots.session_view import HandEyes, TaskEyes

        if self.task is None:
            return HandEyes(self.calibration, self.robot.arm)
        assert self.camera is not None  # or open_cell would have raised
        return TaskEyes(self.task, self.calibration, self.camera, self.robot.arm)

    def servo(self) -> CartesianServo:
        """Return what turns actions into joint targets."""
        from eisp_data.robots.motion import CartesianServo

        return CartesianServo(
            self.robot.arm,
            self.robot.control_hz,
            self.calibration.transform_task_to_base,
            fingers_closed=self.task is not None and self.task.fingers_closed,
        )

    def set_table(self, seed: int, goal: tuple[float, ...] | None) -> np.ndarray:
        """Return the goal (G,) of an episode; the twin's table is set for it as well.

        Raises:
            ConfigError: the goal has not as many numbers as the task needs.
            RobotError: the goal is out of reach.
        """
        if self.task is None:
            return np.empty(0, np.float32)
        if self.has_referee:
            drawn = self.referee.reset(seed)
        else:
            _, drawn = self.task.reset(np.random.default_rng(seed))
        wanted = drawn if goal is None else np.array(goal, np.float32)
        if wanted.shape != drawn.shape:
            raise ConfigError(
                f"--goal: {self.task.name} needs {len(drawn)} numbers; got {len(wanted)}"
            )
        _check_reach(self, wanted)
        return wanted


@contextlib.contextmanager
def open_cell(config: CellConfig) -> Iterator[Cell]:
    """Connect a robot behind the safety filter; disconnect it at the end, whatever happens.

    Raises:
        ConfigError: an unknown name, a missing extra or file, a calibration of another cell, or
            no camera or OpenGL to see a task's objects with.
        RobotError: the robot or its camera does not answer.
    """
    from eisp_data.robots.safe_robot import SafeRobot
    from eisp_data.tasks.registry import get_task

    task = None if config.task is None else get_task(config.task)
    twin = {"task": config.task or "stack", "realtime": config.realtime, "seed": config.seed}
    bare = make_configured(config, twin)
    calibration = _calibration(config, bare)
    robot = SafeRobot(
        bare,
        transform_task_to_base=calibration.transform_task_to_base,
        dry_run=config.dry_run,
    )
    with robot:
        if config.calibration is not None:
            calibration.check(robot)
        robot.calibrate()
        looks = task is not None or config.camera is not None
        camera = choose_camera(config, robot) if looks else None
        if task is not None and camera is None:
            raise ConfigError(
                f"--task {task.name}: {robot.name} has no camera to see its objects with"
            )
        if camera is not None:
            _await_image(robot, camera)
        yield Cell(robot, task, calibration, camera, bare)


def _calibration(config: CellConfig, robot: Robot) -> Calibration:
    from eisp_data.robots.calibration import load_calibration, usual

    if config.calibration is not None:
        return load_calibration(config.calibration)
    own = getattr(robot, "calibration", None)
    if own is not None:
        return own
    if config.task is not None:
        raise ConfigError(
            f"--robot {config.robot}: missing --calibration, a file that eisp-calibrate writes"
        )
    return usual(robot)


def _await_image(robot: SafeRobot, camera: str) -> None:
    """Wait for an image: a camera that cannot give one, a twin's without OpenGL, is told of before
    anything is written.

    Raises:
        ConfigError: there is no OpenGL on this machine.
        RobotError: it does not answer, or gives no image.
    """
    until = robot.now_s() + _FIRST_IMAGE_S
    while camera not in robot.frames():
        if robot.now_s() > until:
            raise RobotError(f"camera {camera!r} gives no image")
        robot.wait_until(robot.now_s() + _ASK_AGAIN_S)


def _check_reach(cell: Cell, goal: np.ndarray) -> None:
    """Raise RobotError for a place that the gripper cannot get to, before anything moves."""
    from eisp_data.robots.cell import apply, transform
    from eisp_data.robots.kinematics import kinematics
    from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M

    low, high = np.array(WORKSPACE_LOW_M), np.array(WORKSPACE_HIGH_M)
    to_base = cell.calibration.transform_task_to_base
    for place in goal.reshape(-1, 3).astype(float):
        x, y, z = place
        inside = np.clip(place, low, high)
        if not np.isfinite(place).all() or np.abs(place - inside).max() > _SLACK_M:
            raise RobotError(
                f"unreachable goal: ({x:.3f}, {y:.3f}, {z:.3f}) m is outside of the workspace, "
                f"{_box(low, high)}"
            )
        target = transform(to_base[:3, :3], apply(to_base, inside))
        kinematics(cell.robot.arm).inverse(target, cell.robot.observe().joint_position)


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return ", ".join(f"{axis} {a:g} to {b:g}" for axis, a, b in zip("xyz", low, high, strict=True))
