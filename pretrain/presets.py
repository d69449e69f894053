"""Named sets of hyperparameters.

``paper`` is the paper's Table I, made for a GPU. ``cpu`` is ours, made for two cores: what differs
and why is in ``docs/method.md``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from eisp_data.errors import ConfigError
from eisp_data.tasks.base import SUCCESS_DISTANCE_M
from eisp_data.tasks.images import image_task
from eisp_data.tasks.registry import TASKS
from pretrain.config import (
    AgentConfig,
    DatasetConfig,
    GoalMix,
    HybridConfig,
    PretrainConfig,
    SacConfig,
    SubgoalConfig,
    VqVaePath,
)
from vqvae.config import VisionConfig

PresetName = Literal["cpu", "paper"]


def preset(name: PresetName, task: str, root: Path, output_dir: Path) -> PretrainConfig:
    """Return the pretraining of a task by the name of its preset."""
    return _PRESETS[name](task, root, output_dir)


def image_preset(
    name: PresetName, vision: VisionConfig, vqvae: Path, root: Path, output_dir: Path
) -> PretrainConfig:
    """Return the pretraining of a task from its images by the name of its preset.

    Args:
        name: of the preset.
        vision: the VQ-VAE that sees them.
        vqvae: its folder.
        root: the dataset.
        output_dir: where the run goes.
    """
    state = preset(name, vision.task, root, output_dir)
    agent = replace(state.agent, task=image_task(vision.task), vision=vision)
    seen = replace(state, agent=agent, vqvae=VqVaePath(vqvae))
    return replace(seen, generator_lr=_PAPER_IMAGE_GENERATOR_LR) if name == "paper" else seen


_FOREIGN_WAYPOINTS = 4
"""The paper's n of Stack and Push4 (Table I)."""
_BETA = 100.0
"""Weight of L_HS where the divergence of many components would leave nothing of it."""


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
            # With the paper's beta its generator says the same of every state: see docs/method.md.
            hybrid=HybridConfig() if known else HybridConfig(beta=_BETA),
            # What an action of zero does there is not known.
            subgoals=SubgoalConfig(rest_when_met=known),
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
                sample_when_stuck=False,
                rest_when_met=False,
            ),
            mix=GoalMix(
                waypoint=0.0,
                future=1.0,
                displaced=0.0,
                complete=0.0,
                furthest=1.0,
                horizon=None,
                errors=0.0,
            ),
        ),
        batch_size=table.batch_size,
        generator_every=1,
        generator_batch_size=table.batch_size,
        generator_lr=table.generator_lr,
        final_lr_share=1.0,
        generator_final_lr_share=1.0,
    )


_PAPER_IMAGE_GENERATOR_LR = 3e-5
"""Appendix "Image-based observation processing", as the batch, which is that of Table I."""


_PRESETS = {"cpu": _cpu, "paper": _paper}
