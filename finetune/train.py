"""Online fine-tuning: rollouts with subgoals, and updates on old and new data (Algorithm 2).

The run goes in rounds. In a round all worlds take the same number of steps, their trajectories
enter the replay, and the networks are updated; physics and learning never compete for the cores.
Worlds start anew only between rounds, so that a trajectory is never cut in the middle of one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from eisp_data.errors import ConfigError, DataError
from eisp_data.runs.metrics import MetricsLog, Speeds
from eisp_data.seeds import SELECTION_SEED, first_online_seed
from eisp_data.sim.gym_worlds import AnyWorlds
from finetune.config import OnlineConfig
from finetune.evaluate import Evaluation, evaluate
from finetune.oracle import subgoal_policy
from finetune.rollout import SubgoalPolicy
from pretrain import checkpoint
from pretrain.agent import Agent
from pretrain.config import GoalMix
from pretrain.learner import Learner, Sample
from pretrain.replay import Trajectories
from pretrain.sac import Batch
from pretrain.saved import POLICY

_CONFIRMING = 3
"""A policy that looks best is tried on so many times the episodes of an evaluation more: the best
of many evaluations has been lucky, too."""

_OF_POLICY = "subgoal", "age", "start", "stuck", "met", "idle", "failed"
"""What a ``SubgoalPolicy`` has to remember."""


@dataclass
class Rollouts:
    """Worlds that are being learned in, and how far each has come."""

    worlds: AnyWorlds
    policy: SubgoalPolicy
    next_seed: int
    solved: np.ndarray
    """(N,) bool: at the end of the last round the goal was met."""

    def start(self, due: np.ndarray) -> None:
        """Start the named worlds anew."""
        seeds = self.next_seed + np.arange(len(due))
        self.worlds.reset(seeds, due)
        self.policy.reset(due)
        self.solved[due] = False
        self.next_seed += len(due)

    def collect(self, steps: int, noise: float) -> tuple[np.ndarray, ...]:
        """Step all worlds, with noise; then start anew those that are over or solved for good.

        Returns:
            Observations, achieved goals, actions and pursued subgoals (R, ...), world after world,
            and the (N + 1,) starts of the worlds' trajectories: each steps + 1 rows, less where a
            world ended.
        """
        worlds = self.worlds
        rows: list[tuple[np.ndarray, ...]] = []
        lengths = np.ones(worlds.count, np.int64)
        for _ in range(steps):
            observation, achieved = worlds.observation, worlds.achieved_goal
            action = self.policy.act(observation, achieved, worlds.desired_goal, noise)
            rows.append((observation, achieved, action, self.policy.subgoal.copy()))
            lengths += ~(worlds.done | worlds.truncated)
            worlds.step(action)
        last = (
            worlds.observation,
            worlds.achieved_goal,
            np.zeros_like(action),
            self.policy.subgoal.copy(),
        )
        lived = np.arange(steps + 1) < lengths[:, None]
        columns = [np.stack(column, 1)[lived] for column in zip(*rows, last, strict=True)]
        # A success that lasted for a round is learned; one that is new has still to be kept.
        over = worlds.truncated | worlds.done | worlds.hopeless | (self.solved & worlds.success)
        self.solved = worlds.success
        self.start(np.flatnonzero(over))
        return *columns, np.concatenate([[0], np.cumsum(lengths)])

    def state(self) -> dict[str, np.ndarray]:
        """Return what ``restore`` needs."""
        worlds = {f"worlds/{name}": value for name, value in self.worlds.snapshot().items()}
        return worlds | {
            **{name: getattr(self.policy, name) for name in _OF_POLICY},
            "solved": self.solved,
            "next_seed": np.array(self.next_seed),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from what ``state`` returned; DataError if it is of another number of worlds."""
        if len(arrays["solved"]) != self.worlds.count:
            raise DataError(
                f"--online.worlds {self.worlds.count}: the run to resume has "
                f"{len(arrays['solved'])}"
            )
        prefix = "worlds/"
        self.worlds.restore_snapshot(
            {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        )
        for name in _OF_POLICY:
            setattr(self.policy, name, arrays[name])
        self.next_seed, self.solved = int(arrays["next_seed"]), arrays["solved"]


class Finetuner:
    """One run of online fine-tuning.

    Args:
        run: its folder.
        agent: what is fine-tuned.
        offline: the dataset that it was pretrained on.
        make_worlds: makes a batch of worlds of a given size.
        config: the hyperparameters.
        seed: of the run.
        threads: how many cores an update may use.
    """

    def __init__(
        self,
        run: Path,
        agent: Agent,
        offline: Trajectories,
        make_worlds: Callable[[int], AnyWorlds],
        config: OnlineConfig,
        seed: int,
        threads: int,
    ) -> None:
        self.run, self.agent, self.config = run, agent, config
        self._offline_mix = agent.config.mix
        self._mix = _with_pursued(agent.config.mix, config.pursued)
        self._rng = np.random.default_rng(seed)
        torch.manual_seed(seed)
        self._offline = offline
        parts = agent.config.waypoints
        if agent.vision and parts is None:
            # What is at rest is known of demonstrations; places read off images waver.
            parts = max(1, config.round_steps // agent.config.subgoals.every_steps)
        self._online = Trajectories(agent.layout, config.replay_size, parts, purposeful=False)
        self._learner = Learner(agent, config.lr, config.generator_lr, threads)
        worlds = make_worlds(config.worlds)
        if worlds.episode_steps % config.round_steps:
            raise ConfigError(
                f"--online.round-steps {config.round_steps} must divide the "
                f"{worlds.episode_steps} steps of an episode"
            )
        policy = subgoal_policy(agent, worlds)
        self._rollouts = Rollouts(
            worlds,
            policy,
            first_online_seed(seed),
            np.zeros(config.worlds, bool),
        )
        self._evaluation_worlds = make_worlds(min(100, config.evaluation_episodes))
        self._curve: list[dict[str, float]] = []
        self._best = -np.inf, -np.inf
        self._round = self._updates = self._env_steps = 0
        self._spent = 0.0

    def __call__(self) -> dict[str, float]:
        """Train, or go on training, to the last round; return the summary of the run."""
        begun = bool(self._curve)
        log = MetricsLog(self.run, "finetune", self._updates if begun else -1)
        start = time.monotonic() - self._spent
        if not begun:
            self._rollouts.start(np.arange(self.config.worlds))
            self._evaluate(log, {}, start)
        rounds = range(self._round + 1, self.config.rounds + 1)
        bar = tqdm(rounds, "fine-tuning", self.config.rounds, initial=self._round, mininterval=1.0)
        speeds = Speeds()
        for self._round in bar:
            with speeds.measured("env_steps", self.config.worlds * self.config.round_steps):
                trajectories = self._rollouts.collect(self.config.round_steps, self.config.noise)
            self._online.extend(*trajectories)
            with speeds.measured("updates", self.config.updates):
                info = self._learn()
            self._env_steps += self.config.worlds * self.config.round_steps
            self._updates += self.config.updates
            if self._round % self.config.evaluate_every == 0 or self._round == self.config.rounds:
                result = self._evaluate(log, {**info, **speeds.taken()}, start)
                bar.set_postfix(success=result.success_last.mean, return_=result.return_.mean)
        log.close()
        return summarise(self._curve) | {"best_success": self._best[0]}

    def _learn(self) -> dict[str, Tensor]:
        config = self.config
        info: dict[str, Tensor] = {}
        remaining = max(0.1, 1.0 - self._round / config.rounds)
        self._learner.set_lr(config.lr * remaining, config.generator_lr * remaining)
        for found in self._learner.updates(self._samples(), self.agent.config.sac.cloning):
            info |= found
        return info

    def _samples(self) -> Iterator[Sample]:
        """Draw what the updates of a round learn from."""
        config = self.config
        offline = round(config.offline_share * config.batch_size) if len(self._offline) else 0
        for update in range(1, config.updates + 1):
            parts = [self._online.transitions(config.batch_size - offline, self._mix, self._rng)]
            if offline:
                parts.append(self._offline.transitions(offline, self._offline_mix, self._rng))
            hindsight = None
            if config.generator_every and update % config.generator_every == 0:
                hindsight = self._hindsight()
            yield Sample(Batch.joined(parts), hindsight)

    def _hindsight(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Draw what the generator learns from, out of old or new data as there is of each.

        Half of it new, as for SAC, it would in the first rounds be the same few trajectories over
        and over: in Store success fell from 72% to 4%. From images it learns from the old alone,
        of which it is known where objects came to rest.
        """
        new, old = len(self._online.leading), len(self._offline.leading)
        if self.agent.vision and old:
            new = 0
        if not new + old:
            return None
        source = self._online if self._rng.random() * (new + old) < new else self._offline
        return source.subgoals(self.config.generator_batch_size, self._mix, self._rng)

    def _evaluate(
        self, log: MetricsLog, info: Mapping[str, Tensor | float], start: float
    ) -> Evaluation:
        result = self._try(0, self.config.evaluation_episodes)
        point = {
            "success_last": result.success_last.mean,
            "success_any": result.success_any.mean,
            "return": result.return_.mean,
        }
        self._curve.append({"env_steps": self._env_steps, **point})
        self._choose(result)
        self._spent = time.monotonic() - start
        values: dict[str, float | Tensor] = {f"train/{k}": v for k, v in info.items()}
        values |= {f"eval/{k}": v for k, v in point.items()}
        log.write(self._updates, self._env_steps, self._spent, values)
        self._checkpoint()
        return result

    def _try(self, first: int, count: int) -> Evaluation:
        return evaluate(self.agent, self._evaluation_worlds, count, SELECTION_SEED + first)

    def _choose(self, result: Evaluation) -> None:
        """Keep the policy as the best if it is, on the episodes of this evaluation and on more."""
        seen = _score(result)
        if seen <= self._best:
            return
        count = self.config.evaluation_episodes
        more = _score(self._try(count, _CONFIRMING * count))
        success, return_ = np.average([seen, more], axis=0, weights=[1, _CONFIRMING]).tolist()
        if (success, return_) > self._best:
            self._best = success, return_
            self.agent.save(self.run / "best" / POLICY)

    def _checkpoint(self) -> None:
        online = self._online
        arrays = self._rollouts.state() | {
            "online/observation": online.observation,
            "online/achieved_goal": online.achieved_goal,
            "online/action": online.action,
            "online/pursued": online.pursued,
            "online/episode_start": online.episode_start,
        }
        numbers = {
            "updates": self._updates,
            "env_steps": self._env_steps,
            "curve": self._curve,
            "best": self._best,
            "wall_s": self._spent,
        }
        checkpoint.save(
            self.run, self._round, self.agent, self._learner.optimizers, self._rng, numbers, arrays
        )

    def restore(self) -> None:
        """Go back to the newest checkpoint; DataError if it is of other settings or older."""
        self._round, numbers, arrays = checkpoint.restore(
            self.run, self.agent, self._learner.optimizers, self._rng
        )
        try:
            self._updates, self._env_steps = numbers["updates"], numbers["env_steps"]
            self._curve, self._spent = numbers["curve"], numbers["wall_s"]
            success, return_ = numbers["best"]
        except KeyError as error:
            raise DataError(
                f"{self.run} is of another version: its checkpoint has no {error}"
            ) from None
        self._best = success, return_
        names = ("observation", "achieved_goal", "action", "pursued", "episode_start")
        self._online.extend(*(arrays[f"online/{name}"] for name in names))
        self._rollouts.restore(arrays)


def _score(result: Evaluation) -> tuple[float, float]:
    """Return what decides which of two policies is better."""
    return result.success_last.mean, result.return_.mean


def _with_pursued(mix: GoalMix, share: float) -> GoalMix:
    """Return the mix with this share of pursued goals, and accordingly less of all the others."""
    others = 1.0 - mix.pursued
    if not others:
        return mix
    rest = (1.0 - share) / others
    return replace(
        mix,
        waypoint=rest * mix.waypoint,
        future=rest * mix.future,
        displaced=rest * mix.displaced,
        pursued=share,
    )


def summarise(curve: list[dict[str, float]]) -> dict[str, float]:
    """Return how deep success fell after going online, and the steps until it was back.

    Args:
        curve: evaluations in time, the first of them before any online step.
    """
    first = curve[0]["success_last"]
    success = [point["success_last"] for point in curve]
    lowest = int(np.argmin(success))
    below = [i for i, value in enumerate(success) if value < first]
    back = [i for i in range(lowest, len(curve)) if success[i] >= first]
    recovered = float("nan")
    if not below:
        recovered = 0.0
    elif back:
        recovered = curve[back[0]]["env_steps"] - curve[below[0] - 1]["env_steps"]
    return {
        "offline_success": first,
        "dip": max(0.0, first - success[lowest]),
        "recovery_steps": recovered,
    }
