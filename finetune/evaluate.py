"""How good a policy is: success, return and subgoals over fresh episodes, with intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from eisp_data.sim.gym_worlds import AnyWorlds
from eisp_data.tasks.images import state_task
from eisp_data.tasks.registry import TASKS
from finetune.oracle import subgoal_policy
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent

_Z = 1.959963984540054
"""Quantile of the normal distribution for a 95% interval."""
_EDGES_M = tuple(round(0.1 * i, 1) for i in range(11))
"""The ranges of the paper's failure analysis; the last is open."""


@dataclass(frozen=True)
class Estimate:
    """A mean with its 95% interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True)
class Distances:
    """Episodes by the distance between their last subgoal and what was achieved at the end."""

    edges: tuple[float, ...]
    """Lower ends of the ranges, m; the last range is open."""
    failures: tuple[int, ...]
    successes: tuple[int, ...]


@dataclass(frozen=True)
class Evaluation:
    """What ``evaluate`` found."""

    task: str
    episodes: int
    seed: int
    success_last: Estimate
    """The goal is met at the last step."""
    success_settled: Estimate | None
    """And all is at rest and let go of; None outside our own tasks."""
    success_any: Estimate
    """The goal was met at some step."""
    return_: Estimate
    relative_return: Estimate | None
    """(R + L) / (R_oracle + L); None where there is no oracle."""
    oracle_return: float | None
    paper_return: float | None
    subgoal_distance: Distances

    def to_plain(self) -> dict[str, object]:
        """Return JSON values."""
        from eisp_data.config import to_plain

        plain = to_plain(self)
        plain["return"] = plain.pop("return_")
        return plain


def evaluate(
    agent: Agent,
    worlds: AnyWorlds,
    episodes: int,
    seed: int,
    *,
    oracle: float | None = None,
    watch: Callable[[AnyWorlds, SubgoalPolicy], None] | None = None,
) -> Evaluation:
    """Run the policy without exploration.

    Args:
        agent: the policy.
        worlds: a batch to run it in.
        episodes: how many; they have the seeds ``seed``, ``seed + 1`` and so on.
        seed: the first.
        oracle: mean return of the oracle, for the relative return.
        watch: called with worlds and policy after every step of the first batch.
    """
    parts = []
    # The same seeds give the same figures, and a run that is evaluated keeps its own randomness.
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for first in range(0, episodes, worlds.count):
            parts.append(_batch(agent, worlds, seed + first, watch if first == 0 else None))
    last, settled, some, returns, distance = (
        np.concatenate(column)[:episodes] for column in zip(*parts, strict=True)
    )
    length = worlds.episode_steps
    relative = None
    if oracle is not None:
        relative = mean_interval((returns + length) / (oracle + length))
    counts = [
        np.histogram(distance[chosen], bins=[*_EDGES_M, np.inf])[0] for chosen in (~last, last)
    ]
    task = TASKS.get(state_task(worlds.name))
    return Evaluation(
        task=worlds.name,
        episodes=episodes,
        seed=seed,
        success_last=share_interval(last),
        success_settled=share_interval(settled) if task else None,
        success_any=share_interval(some),
        return_=mean_interval(returns),
        relative_return=relative,
        oracle_return=oracle,
        paper_return=task.paper.expected_return if task else None,
        subgoal_distance=Distances(
            _EDGES_M, *(tuple(int(count) for count in each) for each in counts)
        ),
    )


def _batch(
    agent: Agent,
    worlds: AnyWorlds,
    seed: int,
    watch: Callable[[AnyWorlds, SubgoalPolicy], None] | None,
) -> tuple[np.ndarray, ...]:
    worlds.reset(range(seed, seed + worlds.count))
    policy = subgoal_policy(agent, worlds)
    returns = np.zeros(worlds.count)
    some = worlds.success
    for _ in range(worlds.episode_steps):
        action = policy.act(worlds.observation, worlds.achieved_goal, worlds.desired_goal)
        worlds.step(action)
        returns += worlds.success - 1.0
        some |= worlds.success
        if watch:
            watch(worlds, policy)
    way = agent.layout.apart(worlds.achieved_goal, policy.subgoal)
    distance = np.linalg.norm(way, axis=1)
    return worlds.success, worlds.success & worlds.settled, some, returns, distance


def share_interval(hits: np.ndarray) -> Estimate:
    """Return the share of True with its Wilson interval (Wilson 1927)."""
    count, share = len(hits), float(hits.mean())
    centre = (share + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    spread = share * (1 - share) / count + _Z**2 / (4 * count**2)
    half = _Z * float(np.sqrt(spread)) / (1 + _Z**2 / count)
    # At the ends the bounds are exact; rounding would leave a 3e-18 there.
    low = centre - half if share > 0.0 else 0.0
    high = centre + half if share < 1.0 else 1.0
    return Estimate(share, low, high)


def mean_interval(values: np.ndarray) -> Estimate:
    """Return the mean with its normal interval."""
    mean = float(values.mean())
    half = _Z * float(values.std(ddof=1)) / float(np.sqrt(len(values))) if len(values) > 1 else 0.0
    return Estimate(mean, mean - half, mean + half)
