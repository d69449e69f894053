"""Named sets of hyperparameters.

``paper`` is the paper's Table I, made for a GPU. ``cpu`` is ours, made for two cores: what differs
and why is in ``docs/method.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from eisp_data.errors import ConfigError
from eisp_data.tasks.base import SUCCESS_DISTANCE_M
from eisp_data.tasks.registry import TASKS
from pretrain.config import (
    AgentConfig,
    DatasetConfig,
    GoalMix,
    HybridConfig,
    PretrainConfig,
    SacConfig,
    SubgoalConfig,
)

PresetName = Literal["cpu", "paper"]


def preset(name: PresetName, task: str, root: Path, output_dir: Path) -> PretrainConfig:
    """Return the pretraining of a task by the name of its preset."""
    return _PRESETS[name](task, root, output_dir)


_FOREIGN_WAYPOINTS = 4
"""The paper's n of Stack and Push4 (Table I)."""


def _cpu(task: str, root: Path, output_dir: Path) -> PretrainConfig:
    objects = len(TASKS[task].objects) if task in TASKS else 1
    known = task in TASKS
    return PretrainConfig(
        dataset=DatasetConfig(root),
        output_dir=output_dir,
        agent=AgentConfig(
            task=task,
            features="objects" if known else "plain",
            generator="movers" if known else "hybrid",
            # In an environment of which nothing is known, nothing may ever come to rest.
            waypoints=None if known else _FOREIGN_WAYPOINTS,
            sac=SacConfig(lr=1e-3, gamma=0.98),
            # Each of n objects may be off by a share of the task's tolerance.
            mix=GoalMix(tolerance_m=SUCCESS_DISTANCE_M / objects**0.5),
        ),
    )


def _paper(task: str, root: Path, output_dir: Path) -> PretrainConfig:
    if task not in TASKS:
        raise ConfigError(f"--preset paper: the paper has no task {task!r}; choose cpu")
    table = TASKS[task].paper
    return PretrainConfig(
        dataset=DatasetConfig(root),
        output_dir=output_dir,
        agent=AgentConfig(
            task=task,
            features="plain",
            generator="hybrid",
            waypoints=table.waypoints,
            sac=SacConfig(
                layers=table.policy_layers,
                lr=table.sac_lr,
                alpha=table.alpha,
                gamma=table.gamma,
                layer_norm=False,
                clip_targets=False,
                cloning=0.0,
            ),
            hybrid=HybridConfig(layers=table.generator_layers, beta=table.beta),
            subgoals=SubgoalConfig(
                selector="value",
                candidates=16,  # the paper does not give K
                every_steps=table.subgoal_steps,
                reached_m=SUCCESS_DISTANCE_M,
            ),
            mix=GoalMix(waypoint=0.0, future=1.0, displaced=0.0, horizon=table.episode_steps),
        ),
        batch_size=table.batch_size,
        generator_every=1,
        generator_batch_size=table.batch_size,
        generator_lr=table.generator_lr,
    )


_PRESETS = {"cpu": _cpu, "paper": _paper}
