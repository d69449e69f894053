"""A batch of worlds of one task that are reset and stepped together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eisp_data.tasks.base import Task, compute_reward, is_success

_FALLEN_M = -0.05
"""Lower than this nothing lies on the table."""


class Worlds:
    """N worlds of one task.

    Attributes:
        state: (N, P) float64, MuJoCo's full physics states.
        desired_goal: (N, G) float32.
        steps: (N,) int64, actions since the last reset.
    """

    def __init__(self, task: Task, count: int, threads: int | None = None) -> None:
        self.task = task
        self.count = count
        self._physics = task.physics(threads)
        self.state = np.zeros((count, self._physics.state_dim))
        self.desired_goal = np.zeros((count, task.paper.goal_dim), np.float32)
        self.steps = np.zeros(count, np.int64)

    def reset(self, seeds: Sequence[int] | np.ndarray, worlds: np.ndarray | None = None) -> None:
        """Start the named worlds (all, if left out) anew, each from its own seed."""
        indices = np.arange(self.count) if worlds is None else np.asarray(worlds)
        for index, seed in zip(indices, seeds, strict=True):
            state, goal = self.task.reset(np.random.default_rng(int(seed)))
            self.restore(state[None], goal[None], np.array([index]))

    def restore(
        self, state: np.ndarray, desired_goal: np.ndarray, worlds: np.ndarray | None = None
    ) -> None:
        """Put the named worlds (all, if left out) into recorded (n, P) states with (n, G) goals."""
        indices = np.arange(self.count) if worlds is None else np.asarray(worlds)
        self.state[indices] = state
        self.desired_goal[indices] = desired_goal
        self.steps[indices] = 0

    def step(self, action: np.ndarray) -> None:
        """Apply (N, A) actions for one control period.

        Raises:
            DataError: an action is not finite, or the physics of a world has broken down.
        """
        self.state = self._physics.step(self.state, self.task.control(self.state, action))
        self.steps += 1

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return all that ``restore_snapshot`` needs to go on from here."""
        arrays = {"state": self.state, "desired_goal": self.desired_goal, "steps": self.steps}
        return {name: array.copy() for name, array in arrays.items()}

    def restore_snapshot(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from a snapshot."""
        self.state, self.desired_goal = arrays["state"].copy(), arrays["desired_goal"].copy()
        self.steps = arrays["steps"].copy()

    @property
    def name(self) -> str:
        """The task's."""
        return self.task.name

    @property
    def episode_steps(self) -> int:
        """L."""
        return self.task.paper.episode_steps

    @property
    def settled(self) -> np.ndarray:
        """(N,) bool: all is at rest and let go of."""
        return self.task.settled(self.state)

    @property
    def observation(self) -> np.ndarray:
        """(N, S) float32."""
        return self.task.observe(self.state)

    @property
    def achieved_goal(self) -> np.ndarray:
        """(N, G) float32."""
        return self.task.achieved_goal(self.state)

    @property
    def success(self) -> np.ndarray:
        """(N,) bool: the paper's Eq. (1) holds now."""
        return is_success(self.achieved_goal, self.desired_goal)

    @property
    def truncated(self) -> np.ndarray:
        """(N,) bool: the episode has had its L steps."""
        return self.steps >= self.episode_steps

    @property
    def done(self) -> np.ndarray:
        """(N,) bool: False, for the goal has to hold until the end."""
        return np.zeros(self.count, bool)

    @property
    def hopeless(self) -> np.ndarray:
        """(N,) bool: an object has fallen off the table, and nothing brings it back."""
        places = self.task.achieved_goal(self.state).reshape(self.count, -1, 3)
        return places[..., 2].min(axis=1) < _FALLEN_M

    @property
    def action_dim(self) -> int:
        """A."""
        return self.task.paper.action_dim

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Return the paper's Eq. (1) for (n, G) goals, (n,) float32."""
        return compute_reward(achieved_goal, desired_goal)
