"""Trajectories, layouts, agents and settings small enough to learn with in a test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from eisp_data.tasks.registry import TASKS
from pretrain.agent import BANK, Agent, empty_moments
from pretrain.config import AgentConfig, HybridConfig, MoversConfig, PretrainConfig, SacConfig
from pretrain.layout import Layout
from pretrain.presets import preset

STEP_M = 0.01
"""How far an object goes in a step while it moves."""


def small(config: AgentConfig) -> AgentConfig:
    """Return the same agent with networks of a few neurons."""
    return replace(
        config,
        sac=replace(config.sac, layers=(16, 16)),
        movers=MoversConfig(width=8),
        hybrid=HybridConfig(layers=(16, 16)),
    )


def tiny_pretraining(root: Path, output_dir: Path, **changes: object) -> PretrainConfig:
    """Return the pretraining of a dataset of Stack in a dozen small updates."""
    config = preset("cpu", "stack", root, output_dir)
    values: dict[str, object] = {
        "agent": small(config.agent),
        "updates": 12,
        "validate_every": 4,
        "batch_size": 16,
        "generator_batch_size": 16,
        "generator_every": 2,
        "device": "cpu",
        "threads": 1,
    }
    return replace(config, **{**values, **changes})  # type: ignore[arg-type]


def make_agent(config: AgentConfig, layout: Layout, seed: int = 0) -> Agent:
    """Return an agent with random weights and a random bank."""
    torch.manual_seed(seed)
    return Agent(config, layout, empty_moments(layout), torch.rand(BANK, layout.goal_dim))


def linear_agent(goal_dim: int = 2, **changes: object) -> Agent:
    """Return an agent of a world without objects whose networks are linear, all weights zero.

    Its observation has as many components as its goal; its action has one.
    """
    config = AgentConfig(
        "linear",
        features="plain",
        generator="hybrid",
        sac=SacConfig(layers=(), layer_norm=False, alpha=0.0),
        hybrid=HybridConfig(layers=(4,)),
    )
    agent = make_agent(replace(config, **changes), Layout(goal_dim, goal_dim, 1))  # type: ignore[arg-type]
    for parameter in agent.sac.parameters():
        parameter.data.zero_()
    return agent


def scene(task: str, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (count, S) observations of a task, with every feature filled, and (count, G) goals."""
    rng = np.random.default_rng(seed)
    paper, slots = TASKS[task].paper, TASKS[task].objects
    observation = rng.normal(0, 0.3, (count, paper.observation_dim))
    goal = np.empty((count, paper.goal_dim))
    low, high = (0.20, -0.18, 0.02), (0.42, 0.18, 0.12)
    for slot in slots:
        place = rng.uniform(low, high, (count, 3))
        observation[:, slot.observation.start : slot.observation.start + 3] = place
        goal[:, slot.goal] = rng.uniform(low, high, (count, 3))
    return torch.tensor(observation, dtype=torch.float32), torch.tensor(goal, dtype=torch.float32)


def path_of(objects: int, stretches: Sequence[tuple[int | None, int]]) -> np.ndarray:
    """Return the achieved goals (T + 1, 3 * objects) of a trajectory.

    Args:
        objects: how many there are.
        stretches: (which object moves or None, for how many steps), one after the other.
    """
    velocity = np.zeros((sum(steps for _, steps in stretches), objects, 3))
    start = 0
    for which, steps in stretches:
        if which is not None:
            velocity[start : start + steps, which, 0] = STEP_M
        start += steps
    places = np.concatenate([np.zeros((1, objects, 3)), velocity.cumsum(0)])
    return (places + 0.1 * np.arange(objects)[:, None]).reshape(len(places), -1).astype(np.float32)
