"""The rollout with subgoals (the paper's Algorithm 1), for training, evaluation and deployment."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from finetune.selector import select
from pretrain.agent import Agent

_LET_GO_STEPS = 10
"""When the final goal has been met for so many steps, and well, what is so is the goal."""
_FAILED = 4
"""How many subgoals that failed are remembered."""
_REST_STEPS = 30
"""After so many the gripper stands still."""


class SubgoalPolicy:
    """Acts in N worlds at once, each with a subgoal of its own.

    Attributes:
        subgoal: (N, G) float32, what each world is heading for.
        age: (N,) int64, steps for which it has been.
        start: (N, G) float32, where all was when it was chosen.
        stuck: (N,) bool, whether the one before was not reached nor come nearer.
        met: (N,) int64, for how many steps in a row the final goal has been met.
        idle: (N,) int64, for how many steps no subgoal was chosen but what was so already.
        failed: (N, 4, G) float32, the last ones that were not reached nor come nearer since one
            was reached; infinite where there are less.
    """

    def __init__(self, agent: Agent, worlds: int) -> None:
        self._agent = agent
        self._config = agent.config.subgoals
        self.subgoal = np.zeros((worlds, agent.layout.goal_dim), np.float32)
        self.age = np.full(worlds, self._config.every_steps)
        self.start = np.full_like(self.subgoal, np.inf)
        self.stuck = np.zeros(worlds, bool)
        self.met: np.ndarray = np.zeros(worlds, np.int64)
        self.idle = np.zeros(worlds, np.int64)
        self.failed = np.full((worlds, _FAILED, agent.layout.goal_dim), np.inf, np.float32)

    def reset(self, worlds: np.ndarray) -> None:
        """Forget the subgoals of the named worlds."""
        self.age[worlds] = self._config.every_steps
        self.start[worlds] = self.failed[worlds] = np.inf
        self.met[worlds] = self.idle[worlds] = 0

    def reached(self, achieved_goal: np.ndarray) -> np.ndarray:
        """Return whether each world is at its subgoal, (N,) bool, of (N, G) achieved goals."""
        return self._distance(achieved_goal, self.subgoal) <= self._config.reached_m

    def _distance(self, goal: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self._agent.layout.apart(goal, other), axis=1)

    @torch.no_grad()
    def act(
        self,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
        noise: float = 0.0,
    ) -> np.ndarray:
        """Renew the subgoals that are reached or too old, and return actions towards them.

        Args:
            observation: (N, S).
            achieved_goal: (N, G).
            desired_goal: (N, G).
            noise: how much of the policy's own noise its actions have, see ``Sac.act``.

        Returns:
            (N, A) float32 in [-1, 1].
        """
        reached = self.reached(achieved_goal)
        missed = self._distance(achieved_goal, desired_goal)
        self.met = (self.met + 1) * (missed <= self._config.final_m)
        done = (self.met > _LET_GO_STEPS) & self._config.rest_when_met
        renew = np.flatnonzero((reached | (self.age >= self._config.every_steps)) & ~done)
        if len(renew):
            self._notice_stuck(renew, reached, achieved_goal)
            self._renew(renew, observation, achieved_goal, desired_goal)
        self.subgoal[done], self.stuck[done] = desired_goal[done], False
        # Nothing is left to correct but large errors: the hand lets go of what is well enough.
        well = done & (missed <= self._config.final_m / 2)
        target = np.where(well[:, None], achieved_goal, self.subgoal)
        self.age += 1
        self.idle += 1
        action = self._act(observation, target, noise)
        stuck = np.flatnonzero(self.stuck)
        if len(stuck) and noise < 1:
            action[stuck] = self._act(observation[stuck], target[stuck], 1.0)
        # It would drift back and touch what it has built.
        action[done & (self.met > _REST_STEPS)] = 0.0
        return action

    def _act(self, observation: np.ndarray, subgoal: np.ndarray, noise: float) -> np.ndarray:
        seen, target = self._tensor(observation), self._tensor(subgoal)
        return self._agent.sac.act(seen, target, noise).cpu().numpy()

    def _notice_stuck(
        self, renew: np.ndarray, reached: np.ndarray, achieved_goal: np.ndarray
    ) -> None:
        """Mark the worlds in which a subgoal was not reached nor come nearer.

        A policy without noise that has come to a standstill stays there. Its own noise frees it:
        until the next subgoal its actions are sampled. A subgoal that fails once more is not chosen
        again soon: it may be one that nobody can reach, a block in a shut drawer. Where the final
        goal is met, nothing is to move: noise would topple the tower.
        """
        was, now = (
            self._distance(self.subgoal[renew], place)
            for place in (self.start[renew], achieved_goal[renew])
        )
        still = was - now < self._config.reached_m
        arrived = reached[renew] | (self.met[renew] > 0)
        self.stuck[renew] = still & ~arrived & self._config.sample_when_stuck
        self.start[renew] = achieved_goal[renew]
        self.failed[renew[arrived]] = np.inf
        stuck = renew[self.stuck[renew]]
        self.failed[stuck] = np.roll(self.failed[stuck], 1, axis=1)
        self.failed[stuck, 0] = self.subgoal[stuck]

    def _renew(
        self,
        renew: np.ndarray,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
    ) -> None:
        """Choose the next subgoals of the worlds named by ``renew``."""
        desired = desired_goal[renew]
        chosen = self._choose(renew, observation[renew], achieved_goal[renew], desired)
        near = self._distance(chosen, desired) <= self._config.final_m
        # A goal that is met is left alone: a generator always knows some other way on.
        final = near | (self.met[renew] > 0)
        self.subgoal[renew] = np.where(final[:, None], desired, chosen)
        self.age[renew] = 0
        self.idle[renew[~self.reached(achieved_goal)[renew]]] = 0

    def _choose(
        self,
        renew: np.ndarray,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
    ) -> np.ndarray:
        """Return a subgoal (n, G) for each of the n worlds named by ``renew``."""
        if self._config.source == "none":
            return desired_goal
        state, goal = self._tensor(observation), self._tensor(desired_goal)
        candidates, likelihood = self._propose(state, goal)
        here = self._tensor(achieved_goal)
        idle = self._tensor(self.idle[renew] >= self._config.every_steps)
        failed = self._tensor(self.failed[renew])
        chosen = select(self._agent, state, here, candidates, likelihood, idle, failed)
        return chosen.cpu().numpy()

    def _propose(self, state: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        count = self._config.candidates
        if self._config.source == "random":
            bank = self._agent.bank
            drawn = bank[torch.randint(len(bank), (len(state), count), device=bank.device)]
            return drawn, torch.zeros(drawn.shape[:2], device=bank.device)
        return self._agent.proposer.propose(state, goal, count)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._agent.bank.device)
