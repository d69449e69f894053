"""Trajectories in memory, and batches of them with goals relabelled in hindsight."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pretrain.config import GoalMix
from pretrain.hindsight import Waypoints, find_waypoints
from pretrain.layout import Layout
from pretrain.sac import Batch

_MOVED_M, _READ_MOVED_M = 0.01, 0.02
"""Going less far is not a move; where places are read off images, they waver."""
_LEAST_STD = 1e-3
"""A dimension that varies by less, a millimetre where it is a length, says nothing."""


class Trajectories:
    """Rows of observations, achieved goals and actions, episode after episode.

    An episode of T actions has T + 1 rows; the action of its last row means nothing.

    Args:
        layout: the environment's.
        capacity: most rows kept; the oldest episodes make room.
        parts: the paper's n for its waypoints; None for waypoints at rest.
        purposeful: whether the trajectories are demonstrations, which end when all is done. After
            their last move they show how to let go and stay away.
    """

    def __init__(
        self, layout: Layout, capacity: int, parts: int | None, *, purposeful: bool
    ) -> None:
        self._layout, self._capacity, self._parts = layout, capacity, parts
        self._purposeful = purposeful
        self.observation = np.empty((0, layout.observation_dim), np.float32)
        self.achieved_goal = np.empty((0, layout.goal_dim), np.float32)
        self.action = np.empty((0, layout.action_dim), np.float32)
        self.pursued = np.empty((0, layout.goal_dim), np.float32)
        self._success = np.empty(0, bool)
        self.episode_start = np.zeros(1, np.int64)
        self.waypoints = Waypoints(*(np.empty(0, np.int64) for _ in range(3)))
        self._moved_m = _READ_MOVED_M if layout.latent_dim else _MOVED_M
        self._index()

    def __len__(self) -> int:
        return len(self.observation)

    def extend(
        self,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        action: np.ndarray,
        pursued: np.ndarray,
        episode_start: np.ndarray,
        places: np.ndarray | None = None,
        success: np.ndarray | None = None,
    ) -> None:
        """Append whole episodes.

        Args:
            observation: (R, S).
            achieved_goal: (R, G).
            action: (R, A).
            pursued: (R, G), the goals that the actions were meant for: the subgoals of a rollout,
                the final goal of a demonstration.
            episode_start: (E + 1,).
            places: (R, P) where the objects were, metres, if the achieved goals do not say it.
            success: (R,) bool, whether a demonstration's own goal is met; needed of these alone.
        """
        starts = np.concatenate([self.episode_start, len(self) + np.asarray(episode_start[1:])])
        first = int(np.searchsorted(starts, starts[-1] - self._capacity))
        cut = int(starts[first])
        self.observation = np.concatenate([self.observation, observation])[cut:]
        self.achieved_goal = np.concatenate([self.achieved_goal, achieved_goal])[cut:]
        self.action = np.concatenate([self.action, action])[cut:]
        self.pursued = np.concatenate([self.pursued, pursued])[cut:]
        met = np.zeros(len(observation), bool) if success is None else success
        self._success = np.concatenate([self._success, met])[cut:]
        self.episode_start = starts[first:] - cut
        moving = achieved_goal if places is None else places
        added = find_waypoints(moving, np.asarray(episode_start), self._parts)
        self.waypoints = self.waypoints.joined(added).without_first(cut)
        self._index()

    def _index(self) -> None:
        lengths = np.diff(self.episode_start)
        self._last = np.repeat(self.episode_start[1:] - 1, lengths)
        self.acting = np.flatnonzero(np.arange(len(self)) < self._last)
        """Rows that have an action."""
        self.leading = self.acting[self.waypoints.following[self.acting] >= 0]
        """Rows that have a waypoint after them."""
        self._guiding = self.acting if self._purposeful else self.leading
        self._complete = self.leading[self._success[self.waypoints.furthest(self.leading)]]
        """Rows of ``leading`` after which a demonstration's own goal is met at rest."""
        self._next_rest = self._last.copy()
        ahead = self.waypoints.following >= 0
        self._next_rest[ahead] = self.waypoints.row[self.waypoints.following[ahead]]
        """For each row the next waypoint, or where there is none the end of the episode."""

    def transitions(self, count: int, mix: GoalMix, rng: np.random.Generator) -> Batch:
        """Draw transitions with goals relabelled as the mix says."""
        # Of many short rows, ``take`` gathers three times as many in a second as an index does.
        kind = rng.choice(4, size=count, p=[mix.waypoint, mix.future, mix.displaced, mix.pursued])
        rows = self.acting.take(rng.integers(len(self.acting), size=count))
        if len(self._guiding):
            lead = kind == 0
            rows[lead] = self._guiding[rng.integers(len(self._guiding), size=int(lead.sum()))]
        else:
            kind[kind == 0] = 1
        future = self._later(rows, mix.horizon, rng)
        source = np.where(kind == 0, self._next_rest[rows], future)
        goal = self.achieved_goal.take(source, 0)
        self._displace(goal, rows, kind == 2, rng)
        start, after = (self.achieved_goal.take(rows + k, 0) for k in (0, 1))
        apart = self._layout.apart
        moved = np.linalg.norm(apart(goal, start), axis=1) > self._moved_m
        self._jitter(goal, mix, rng)
        goal[kind == 3] = self.pursued[rows[kind == 3]]
        reached = np.linalg.norm(apart(after, goal), axis=1) <= mix.tolerance_m
        # What a trajectory does while nothing moves yet serves its next move, not this goal.
        at_end = (kind == 0) & (source == self._last[rows])
        clone = (kind < 2) & (moved | at_end)
        return Batch(
            observation=torch.from_numpy(self.observation.take(rows, 0)),
            action=torch.from_numpy(self.action.take(rows, 0)),
            next_observation=torch.from_numpy(self.observation.take(rows + 1, 0)),
            goal=torch.from_numpy(goal),
            reward=torch.from_numpy(reached.astype(np.float32) - 1.0),
            clone=torch.from_numpy(clone.astype(np.float32)),
            demonstrated=torch.full((count,), float(self._purposeful)),
        )

    def _later(self, rows: np.ndarray, horizon: int | None, rng: np.random.Generator) -> np.ndarray:
        """Return for each row one that comes after it, see ``GoalMix.horizon``."""
        if horizon is None:
            return rng.integers(rows + 1, self._last[rows] + 1)
        return np.minimum(rows + rng.integers(1, horizon + 1, size=len(rows)), self._last[rows])

    def _displace(
        self, goal: np.ndarray, rows: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> None:
        """Let the chosen goals be where all is now, but for one object."""
        picked = np.flatnonzero(chosen)
        if not len(picked):
            return
        goal[picked] = self.achieved_goal[rows[picked]]
        objects = self._layout.objects
        if not objects:
            goal[picked] = self.achieved_goal[rng.integers(len(self), size=len(picked))]
            return
        which = rng.integers(len(objects), size=len(picked))
        columns = np.array([item.goal for item in objects])[which][:, None] + np.arange(3)
        elsewhere = self.achieved_goal[rng.integers(len(self), size=len(picked))]
        goal[picked[:, None], columns] = np.take_along_axis(elsewhere, columns, axis=1)

    def moments(self) -> dict[str, Tensor]:
        """Return means and standard deviations of observations and goals.

        A dimension that hardly varies gets deviation one, so that it standardises to almost zero.
        """
        result = {}
        for name, array in (("observation", self.observation), ("goal", self.achieved_goal)):
            mean, std = array.mean(0, dtype=np.float64), array.std(0, dtype=np.float64)
            std[std < _LEAST_STD] = 1.0
            result[f"{name}_mean"] = torch.from_numpy(mean.astype(np.float32))
            result[f"{name}_std"] = torch.from_numpy(std.astype(np.float32))
        return result

    def _jitter(self, goal: np.ndarray, mix: GoalMix, rng: np.random.Generator) -> None:
        """Add the mix's errors to (B, G) goals."""
        places = goal[:, : self._layout.places_dim]
        std = mix.errors * mix.tolerance_m / places.shape[1] ** 0.5
        places += rng.standard_normal(places.shape, np.float32) * np.float32(std)

    def subgoals(
        self, count: int, mix: GoalMix, rng: np.random.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw what a generator learns from.

        Returns:
            Observations (count, S), final goals (count, G) and the next waypoints (count, G).
        """
        whole = round(mix.complete * count) if len(self._complete) else 0
        rows = self.leading[rng.integers(len(self.leading), size=count)]
        rows[:whole] = self._complete[rng.integers(len(self._complete), size=whole)]
        subgoal, goal = self.waypoints.subgoal_and_goal(rows, mix.furthest, rng)
        goal[:whole] = self.waypoints.furthest(rows[:whole])
        final = self.achieved_goal[goal]
        self._jitter(final, mix, rng)
        return (
            torch.from_numpy(self.observation[rows]),
            torch.from_numpy(final),
            torch.from_numpy(self.achieved_goal[subgoal]),
        )
