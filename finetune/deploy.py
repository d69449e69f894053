"""A policy on a robot: subgoals, actions, recording, curve and films; on the twin, a verdict."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields, replace
from itertools import count
from pathlib import Path

import numpy as np

from eisp_data.config import at_least, check_seed, load_yaml, save_yaml
from eisp_data.errors import ConfigError, EispError, RobotError
from eisp_data.robots.record_controllers import Controller, Decision, Limited, Script, Slowed
from eisp_data.robots.session import Ended
from eisp_data.robots.session_cell import Cell
from eisp_data.robots.session_run import Plan, Report, run_session
from eisp_data.robots.session_view import Seen
from eisp_data.seeds import check_unlearned
from eisp_data.sim.scene import CONTROL_HZ
from eisp_data.storage.files import replace_atomically
from eisp_data.tasks.base import SUCCESS_DISTANCE_M, Task
from eisp_data.tasks.registry import get_task
from finetune.deploy_config import DeployConfig
from finetune.deploy_policy import Looking, PolicyController
from finetune.deploy_trace import distance_curve, read_traces
from finetune.disturb import Hand
from finetune.evaluate import share_interval
from finetune.run import check_layout, load_for_rollouts
from pretrain.agent import Agent
from pretrain.checks import check_subgoals
from pretrain.config import SubgoalConfig
from pretrain.device import set_up
from pretrain.layout import Layout
from pretrain.saved import saved_subgoals

RESULTS, SETTINGS = "results.jsonl", "deploy.yaml"
_MAY_DIFFER = {
    "output_dir",
    "resume",
    "episodes",
    "pause_s",
    "record_images",
    "host",
    "camera_source",
    "realtime",
    "device",
    "threads",
}
"""Settings that do not decide how an episode goes."""
_LOOKS = 2.5
"""With looks an episode may take so many times as long as the policy's steps alone."""
_SETTLE_S = 0.5


@dataclass
class _Run:
    """What the parts of one deployment share."""

    config: DeployConfig
    task: Task
    agent: Agent | None
    report: Report
    first: int
    hand: Hand | None = None
    cell: Cell | None = None
    lines: list[str] = field(default_factory=list)

    def controller(self, cell: Cell) -> Controller:
        """Return who decides, once robot and camera have proved usable; the settings are saved,
        for now there will be something to go on with."""
        self.cell = cell
        _save_settings(self.config)
        if self.config.interference:
            self.hand = Hand(cell.referee, self.task)
        found: Controller
        if self.agent is None:
            found = Script(self.task)
        else:
            found = PolicyController(self.agent)
            if self.config.look:
                found = Looking(found, self.task)
        limited = Limited(found, self.task.paper.episode_steps)
        return Slowed(limited, self.task, self.config.ticks_per_step)

    def stopped(self, fault: str) -> None:
        """Note an episode that a fault ended: on the twin it is a failure, and --resume goes on."""
        started = self.first + len(self.report.episodes)
        if self.config.robot == "twin" and len(self.report.goals) > len(self.report.episodes):
            self._note(
                {
                    "episode": started,
                    "seed": self.config.seed + started,
                    "outcome": "stopped",
                    "fault": fault,
                    "success": False,
                }
            )

    def _note(self, entry: dict[str, object]) -> None:
        with (self.config.output_dir / RESULTS).open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def watch(self, step: int, seen: Seen, decision: Decision) -> None:
        """Let the hand see each tick."""
        if self.hand is None:
            return
        if step == 0:
            number = self.first + len(self.report.episodes)
            self.hand.begin(self.report.goals[-1], self.config.seed + number)
        self.hand(step, seen, decision)

    def after(self, number: int, cell: Cell, goal: np.ndarray, ended: Ended) -> None:
        """Note how an episode ended; of a twin, how it really ended."""
        entry: dict[str, object] = {
            "episode": number,
            "seed": self.config.seed + number,
            "outcome": ended.outcome,
            "ticks": ended.ticks,
            "distance_m": round(ended.distance_m, 4),
            "subgoals": ended.subgoals,
        }
        if cell.has_referee and ended.outcome:
            cell.robot.wait_until(cell.robot.now_s() + _SETTLE_S)
            entry["success"] = cell.referee.success(goal)
            entry["settled"] = cell.referee.settled()
        if self.hand is not None:
            entry["interfered"] = self.hand.moved
        if ended.outcome:
            self._note(entry)


def deploy(config: DeployConfig) -> Report:
    """Run a policy on a robot, and print what became of it, also if it ended in an error."""
    task, agent = _prepare(config)
    first = _done_before(config)
    report = Report(_free_name(config.output_dir, first))
    run = _Run(config, task, agent, report, first)
    if first >= config.episodes:
        print("\n".join(_verdict(config)))
        return report
    try:
        run_session(config, _plan(run), run.controller, report, run.watch, run.after)
    except RobotError as error:
        run.stopped(str(error))
        raise
    finally:
        for line in report.lines():
            print(line)
        if report.stats is not None:
            _draw(run)
    print("\n".join(_verdict(config)))
    return report


def policy_controller(path: Path | None, task: Task) -> Controller:
    """Return a policy as ``eisp-record --control policy`` wants it."""
    if path is None:
        raise ConfigError("--control policy: missing --policy.path, the folder of a policy")
    return PolicyController(load_policy(path, task, saved_subgoals(path), "cpu"))


def load_policy(path: Path | None, task: Task, subgoals: SubgoalConfig, device: str) -> Agent:
    """Read a policy for a task; ConfigError if it is one of another task or needs a simulator."""
    if subgoals.source == "oracle":
        raise ConfigError("--subgoals.source oracle needs a simulator; choose another for a robot")
    agent = load_for_rollouts(path, subgoals, device)
    if agent.config.task != task.name:
        raise ConfigError(f"{path} is a policy of {agent.config.task!r}, not of {task.name!r}")
    check_layout(agent, Layout.of(task))
    return agent


def _prepare(config: DeployConfig) -> tuple[Task, Agent | None]:
    """Return task and policy; whatever is wrong with them is said before anything is connected."""
    at_least(
        1,
        {
            "--episodes": config.episodes,
            "--ticks-per-step": config.ticks_per_step,
            "--threads": config.threads,
        },
    )
    check_seed(config.seed)
    if config.robot == "twin":
        check_unlearned(config.seed, config.episodes)
    if config.episode_s is not None and not 0 < config.episode_s < float("inf"):
        raise ConfigError(f"--episode-s must be above 0; got {config.episode_s}")
    if config.task is None:
        raise ConfigError("missing --task")
    task = get_task(config.task)
    if config.interference and config.robot != "twin":
        raise ConfigError(f"--interference: only the twin has such a hand, not {config.robot}")
    if config.control == "script":
        return task, None
    check_subgoals(config.subgoals, "--subgoals")
    device = set_up(config.device, config.threads)
    return task, load_policy(config.policy.path, task, config.subgoals, device)


def _done_before(config: DeployConfig) -> int:
    """Return how many episodes the output folder has."""
    folder = config.output_dir
    # Settings alone are left where nothing could begin.
    if not folder.exists() or not any(path.name != SETTINGS for path in folder.iterdir()):
        return 0
    if not config.resume:
        raise ConfigError(
            f"{folder} is not empty; add --resume to go on with it, or choose another --output-dir"
        )
    if (folder / SETTINGS).exists():
        _check_same(config, load_yaml(DeployConfig, folder / SETTINGS))
    results = folder / RESULTS
    if not results.exists():
        return 0
    lines = results.read_text().splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]  # a kill may have cut off the last
    if whole != lines:
        replace_atomically(results, lambda draft: draft.write_text("".join(whole)))
    return len(whole)


def _check_same(config: DeployConfig, begun: DeployConfig) -> None:
    """Raise ConfigError if episodes of the two would not be of one kind."""
    different = [
        f"--{one.name.replace('_', '-')}"
        for one in fields(DeployConfig)
        if one.name not in _MAY_DIFFER and getattr(config, one.name) != getattr(begun, one.name)
    ]
    if different:
        raise ConfigError(
            f"--resume: {config.output_dir} was begun with another {', '.join(different)}; give "
            "the same, or choose another --output-dir"
        )


def _save_settings(config: DeployConfig) -> None:
    config.output_dir.mkdir(parents=True, exist_ok=True)
    save_yaml(replace(config, resume=False), config.output_dir / SETTINGS)


def _free_name(folder: Path, first: int) -> Path:
    """Return where to record the episodes from this one on: an episode that a fault cut off has
    left a recording and may have left no result."""
    names = (folder / f"session_{number:04d}.mcap" for number in count(first))
    return next(path for path in names if not path.exists())


def _plan(run: _Run) -> Plan:
    config, task = run.config, run.task
    steps = task.paper.episode_steps * config.ticks_per_step * (_LOOKS if config.look else 1.0)
    metadata = {
        "robot": config.robot,
        "control": config.control,
        "task": task.name,
        "instruction": task.instruction,
    }
    return Plan(
        run.report.output,
        config.episodes - run.first,
        steps / CONTROL_HZ if config.episode_s is None else config.episode_s,
        config.pause_s,
        metadata,
        run.first,
        config.record_images,
    )


def _draw(run: _Run) -> None:
    """Draw the distance curve and the films of what was recorded."""
    from eisp_data.robots.pose import View
    from finetune.deploy_film import film

    config, cell = run.config, run.cell
    traces = read_traces(run.report.output)
    if not traces or cell is None:
        return
    curve = run.report.output.with_suffix(".svg")
    curve.write_text(distance_curve(traces, run.first, SUCCESS_DISTANCE_M))
    print(f"{curve}: distance to the goal over time")
    if not config.record_images or cell.camera is None:
        return
    placed = cell.calibration
    view = View(placed.cameras[cell.camera], placed.transform_base_to_task)
    for number, trace in enumerate(traces, start=run.first):
        to = config.output_dir / f"episode_{number:04d}.mp4"
        if film(run.report.output, trace, cell.camera, view, run.task, to):
            print(f"{to}: the camera's view with subgoals and goal")


def _verdict(config: DeployConfig) -> list[str]:
    """Return the share of episodes that really succeeded, with its 95% interval."""
    path = config.output_dir / RESULTS
    if not path.exists():
        return []
    try:
        entries = [json.loads(line) for line in path.read_text().splitlines()]
        judged = [entry for entry in entries if "success" in entry]
        hits = np.array([entry["success"] for entry in judged], bool)
        moved = sum(entry.get("interfered", False) for entry in judged)
    except (ValueError, TypeError, KeyError):
        raise EispError(f"{path} holds no results that can be read") from None
    if not judged:
        return []
    lines = [f"success, by the twin's referee: {share_interval(hits)} of {len(hits)} episodes"]
    if config.interference:
        lines.append(f"a hand took a block away in {moved} of them")
    return lines
