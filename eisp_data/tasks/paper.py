"""The numbers that the paper gives for each task: its Table I, Table II and appendix."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperSettings:
    """One column of Table I ("Parameters setting") and the task's entry of Table II."""

    observation_dim: int
    """S"""
    goal_dim: int
    """G"""
    action_dim: int
    """A"""
    episode_steps: int
    """L"""
    replay_size: int
    """D"""
    batch_size: int
    """N"""
    sac_lr: float
    policy_layers: tuple[int, ...]
    """pi"""
    alpha: float
    """alpha, SAC's fixed temperature."""
    gamma: float
    generator_lr: float
    """EISP lr"""
    subgoal_steps: int
    """T, the steps that a subgoal may take."""
    waypoints: int
    """n, the parts into which the hindsight sampler cuts a trajectory."""
    generator_layers: tuple[int, ...]
    """psi"""
    beta: float
    """beta of Eq. (14), the weight of L_HS."""
    expected_return: float
    """Table II, row "EISP (Ours)"."""


STACK = PaperSettings(
    observation_dim=55,
    goal_dim=9,
    action_dim=4,
    episode_steps=300,
    replay_size=100_000,
    batch_size=1024,
    sac_lr=3e-3,
    policy_layers=(256,) * 2,
    alpha=0.01,
    gamma=0.99,
    generator_lr=1e-5,
    subgoal_steps=30,
    waypoints=4,
    generator_layers=(256,) * 2,
    beta=1e-2,
    expected_return=-89.29,
)
PUSH4 = PaperSettings(
    observation_dim=70,
    goal_dim=12,
    action_dim=4,
    episode_steps=400,
    replay_size=1_000_000,
    batch_size=1024,
    sac_lr=3e-4,
    policy_layers=(256,) * 3,
    alpha=0.01,
    gamma=0.99,
    generator_lr=1e-5,
    subgoal_steps=30,
    waypoints=4,
    generator_layers=(256,) * 2,
    beta=1e-2,
    expected_return=-228.89,
)
OPEN_DRAWER = PaperSettings(
    observation_dim=42,
    goal_dim=6,
    action_dim=4,
    episode_steps=300,
    replay_size=1_000_000,
    batch_size=1024,
    sac_lr=3e-4,
    policy_layers=(512,) * 4,
    alpha=0.01,
    gamma=0.99,
    generator_lr=1e-5,
    subgoal_steps=50,
    waypoints=6,
    generator_layers=(512,) * 4,
    beta=1e-3,
    expected_return=-246.91,
)
STORE = PaperSettings(
    observation_dim=42,
    goal_dim=6,
    action_dim=4,
    episode_steps=1000,
    replay_size=1_000_000,
    batch_size=1024,
    sac_lr=3e-3,
    policy_layers=(512,) * 4,
    alpha=0.01,
    gamma=0.99,
    generator_lr=1e-5,
    subgoal_steps=50,
    waypoints=6,
    generator_layers=(512,) * 4,
    beta=1e-3,
    expected_return=-581.96,
)
