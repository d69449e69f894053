"""A robot and its camera as a command line names them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from eisp_data.errors import ConfigError

if TYPE_CHECKING:
    from eisp_data.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """Which robot, and which of its cameras."""

    robot: str = "twin"
    """twin (a simulated UR3 cell), ur3 or tiago."""
    host: str | None = None
    """Address of a real robot."""
    side: Literal["left", "right"] | None = None
    """Which arm of a tiago; the left one if left out."""
    camera_source: str | None = None
    """Where a real robot's camera is: what OpenCV opens (0, a path), or a ROS topic for tiago."""
    camera: str | None = None
    """The camera that looks at the table; the only one if left out."""


def make_configured(config: RobotConfig, twin_options: dict[str, Any]) -> Robot:
    """Make the robot, not yet connected.

    Args:
        config: which.
        twin_options: of ``TwinRobot``, if that is it.

    Raises:
        ConfigError: an unknown name, a missing address or extra, or a side of a one-armed robot.
    """
    from eisp_data.robots.registry import ROBOTS, make_robot

    options: dict[str, Any] = {}
    if config.side is not None and config.robot != "tiago":
        raise ConfigError(f"--side {config.side}: only tiago has two arms, not {config.robot}")
    if config.robot == "twin":
        options = twin_options
    elif config.robot in ROBOTS:
        if config.host is None:
            raise ConfigError(f"--robot {config.robot}: missing --host, the robot's address")
        options = {"host": config.host, "camera": config.camera_source}
        if config.side is not None:
            options["side"] = config.side
    return make_robot(config.robot, **options)


def choose_camera(config: RobotConfig, robot: Robot) -> str | None:
    """Return the name of the camera that looks at the table, None if the robot has no camera.

    Raises:
        ConfigError: it has not that one, or several and none was chosen.
    """
    names = list(robot.cameras)
    if config.camera in names:
        return config.camera
    if config.camera is None and len(names) < 2:
        return names[0] if names else None
    asked = "missing --camera" if config.camera is None else f"--camera {config.camera}"
    raise ConfigError(f"{asked}: choose one of {', '.join(names) or 'none: there is no camera'}")
