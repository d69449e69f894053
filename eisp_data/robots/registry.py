"""The robots by name; none is imported before it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from eisp_data.errors import ConfigError
from eisp_data.robots.robot import Robot


@dataclass(frozen=True)
class _Entry:
    factory: str
    """``module:class``, called with the options of ``make_robot``."""
    extra: str
    """The optional extra with what the module imports."""


ROBOTS: dict[str, _Entry] = {
    "twin": _Entry("eisp_data.robots.twin.robot:TwinRobot", "robot"),
    "ur3": _Entry("eisp_data.robots.ur3:Ur3Robot", "ur3"),
    "tiago": _Entry("eisp_data.robots.tiago:TiagoRobot", "tiago"),
}


def make_robot(name: str, **options: Any) -> Robot:
    """Make the robot of that name, not yet connected.

    Args:
        name: a name in ``ROBOTS``.
        options: of the robot's own constructor.

    Raises:
        ConfigError: no such robot, or its extra is not installed.
    """
    if name not in ROBOTS:
        raise ConfigError(f"unknown robot {name!r}; choose one of {', '.join(ROBOTS)}")
    entry = ROBOTS[name]
    module, _, factory = entry.factory.partition(":")
    try:
        made = getattr(import_module(module), factory)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("eisp_data"):
            raise
        raise ConfigError(
            f"robot {name!r} needs {error.name}: pip install 'eisp[{entry.extra}]'"
        ) from None
    return made(**options)
