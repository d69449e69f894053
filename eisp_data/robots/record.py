"""A session that is recorded: by whom the robot is moved, and what the recording says of itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from eisp_data.config import at_least
from eisp_data.errors import ConfigError
from eisp_data.robots.session_cell import Cell, CellConfig

if TYPE_CHECKING:
    from eisp_data.robots.record_controllers import Controller
    from eisp_data.robots.session_run import Plan, Report

CONTROLLERS = "eisp.controllers"
"""Entry points by which packages to the right of this one, and others, offer controllers: callables
that take the policy's path and the cell's task and return a ``Controller``."""
_HUMANS = ("keyboard", "gamepad")


@dataclass(frozen=True)
class PolicyFile:
    """A policy on the disk."""

    path: Path | None = None
    """A run, a checkpoint, or a folder with ``model.safetensors``."""


@dataclass(frozen=True, kw_only=True)
class RecordConfig(CellConfig):
    """What to record, and where to."""

    output: Path
    """The recording, an MCAP file that does not exist yet."""
    control: str = "script"
    """Who moves the robot: keyboard, gamepad, script (of the task), or policy."""
    policy: PolicyFile = field(default_factory=PolicyFile)
    watch: Literal["keyboard", "gamepad"] | None = None
    """A device with which a human may take over from a script or a policy."""
    episodes: int = 1
    episode_s: float = 120.0
    """The longest that an episode may last."""
    pause_s: float = 30.0
    """Between two episodes a human has so long to set the table, or presses enter before."""
    ticks_per_step: int = 2
    """Ticks of the robot for each step of a script or a policy, which were made for 1 m/s."""
    teleop_speed: float = 0.25
    """Share of 1 m/s that a key, or a stick at its end, gives."""
    operator: str = ""
    """Who it is that moves the robot, for the dataset."""


def record(config: RecordConfig) -> Report:
    """Record a session, and print what became of it, also if it ended in an error."""
    from eisp_data.robots.session_run import Report, run_session

    check(config)
    report = Report(config.output)
    try:
        run_session(config, plan(config), lambda cell: controller(config, cell), report)
    finally:
        for line in report.lines():
            print(line)
    return report


def check(config: RecordConfig) -> None:
    """Raise ConfigError for settings that cannot be used, before anything is connected."""
    at_least(1, {"--episodes": config.episodes, "--ticks-per-step": config.ticks_per_step})
    if not 0 < config.episode_s < float("inf"):
        raise ConfigError(f"--episode-s must be above 0; got {config.episode_s}")
    if not 0 < config.teleop_speed <= 1:
        raise ConfigError(
            f"--teleop-speed must be above 0 and at most 1; got {config.teleop_speed}"
        )
    if config.output.exists():
        raise ConfigError(f"{config.output} exists already; a recording is never overwritten")
    if config.control not in _HUMANS and config.task is None:
        raise ConfigError(f"--control {config.control}: missing --task")
    known = [*_HUMANS, "script", *_offered()]
    if config.control not in known:
        raise ConfigError(f"--control {config.control}: choose one of {', '.join(known)}")


def plan(config: RecordConfig) -> Plan:
    """Return the plan of the session."""
    from eisp_data.robots.session_run import Plan
    from eisp_data.tasks.registry import get_task

    metadata = {"robot": config.robot, "control": config.control, "operator": config.operator}
    if config.task is not None:
        task = get_task(config.task)
        metadata |= {"task": task.name, "instruction": task.instruction}
    return Plan(config.output, config.episodes, config.episode_s, config.pause_s, metadata)


def controller(config: RecordConfig, cell: Cell) -> Controller:
    """Return who decides."""
    from eisp_data.robots.record_controllers import Human, Limited, Script, Slowed, Watched
    from eisp_data.robots.teleop import Teleop

    if config.control == "keyboard":
        return Human(Teleop("keyboard"), config.teleop_speed)
    if config.control == "gamepad":
        return Human(Teleop("gamepad"), config.teleop_speed)
    assert cell.task is not None
    found: Controller
    if config.control == "script":
        found = Script(cell.task)
    else:
        found = _offered()[config.control].load()(config.policy.path, cell.task)
    limited = Limited(found, cell.task.paper.episode_steps)
    slowed = Slowed(limited, cell.task, config.ticks_per_step)
    if config.watch is None:
        return slowed
    return Watched(slowed, Human(Teleop(config.watch), config.teleop_speed))


def _offered() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=CONTROLLERS)}
