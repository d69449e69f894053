"""Any Gymnasium ``GoalEnv`` in place of our tasks: N copies behind the interface of ``Worlds``."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from eisp_data.errors import ConfigError
from eisp_data.sim.worlds import Worlds

_PARTS = ("observation", "achieved_goal", "desired_goal")
_SUCCESS_KEYS = ("is_success", "success")


class GymWorlds:
    """N copies of a registered ``GoalEnv`` in this process.

    Actions are in [-1, 1] and scaled to the bounds of the environment's own.

    Attributes:
        name: the environment's id.
        count: N.
        observation_dim: S.
        goal_dim: G.
        action_dim: A.
        episode_steps: L, the limit that the environment is registered with.
        fps: steps per second of simulated time; 25 if the environment does not say.
        state: (N, 0) float64: a foreign simulator's state is not recorded.
        observation: (N, S) float32.
        achieved_goal: (N, G) float32.
        desired_goal: (N, G) float32.
        success: (N,) bool, as the environment itself says; False until the first step where it
            says nothing at the reset.
        done: (N,) bool: the environment itself ended the episode.
        truncated: (N,) bool: it cut the episode off, after L steps at the latest.
        steps: (N,) int64, actions since the last reset.
    """

    def __init__(self, env_id: str, count: int) -> None:
        """Make the copies; call ``reset`` first.

        Raises:
            ConfigError: no such environment, or it is not a GoalEnv with flat arrays, or it has no
                limit of steps.
        """
        self.name, self.count = env_id, count
        self._envs = [_make(env_id) for _ in range(count)]
        dims, action_space = _check(self._envs[0], env_id)
        self.observation_dim, self.goal_dim, _ = dims
        self._centre = (action_space.high + action_space.low) / 2
        self._half = (action_space.high - action_space.low) / 2
        self.action_dim = len(self._centre)
        assert self._envs[0].spec is not None
        self.episode_steps = int(self._envs[0].spec.max_episode_steps or 0)
        self.fps = int(self._envs[0].metadata.get("render_fps") or 25)
        self.state = np.zeros((count, 0))
        self.observation = np.zeros((count, self.observation_dim), np.float32)
        self.achieved_goal = np.zeros((count, self.goal_dim), np.float32)
        self.desired_goal = np.zeros((count, self.goal_dim), np.float32)
        self.success = np.zeros(count, bool)
        self.done = np.zeros(count, bool)
        self.truncated = np.zeros(count, bool)
        self.steps = np.zeros(count, np.int64)
        self._seeds = np.zeros(count, np.int64)
        self._actions = np.zeros((count, self.episode_steps, self.action_dim), np.float32)

    def reset(self, seeds: Sequence[int] | np.ndarray, worlds: np.ndarray | None = None) -> None:
        """Start the named worlds (all, if left out) anew, each from its own seed."""
        indices = np.arange(self.count) if worlds is None else np.asarray(worlds)
        self._turn_page()
        for index, seed in zip(indices, seeds, strict=True):
            seen, info = self._envs[index].reset(seed=int(seed))
            self._see(index, seen, info)
            self.done[index] = self.truncated[index] = False
            self._seeds[index] = seed
        self.steps[indices] = 0

    def step(self, action: np.ndarray) -> None:
        """Apply (N, A) actions in [-1, 1] for one step.

        A world that is over is left as it is until its reset.
        """
        exact = np.asarray(action, np.float32)  # what a snapshot holds is what was done
        self._turn_page()
        for index in np.flatnonzero(~self.done & ~self.truncated):
            self._step(index, exact[index])

    def _turn_page(self) -> None:
        """Go on in new arrays: who has taken one keeps what it was shown, as with ``Worlds``."""
        for name in (*_PARTS, "success", "done", "truncated"):
            setattr(self, name, getattr(self, name).copy())

    def _step(self, index: int, action: np.ndarray) -> None:
        scaled = self._centre + self._half * np.clip(action, -1.0, 1.0)
        seen, _, done, truncated, info = self._envs[index].step(scaled.astype(self._centre.dtype))
        self._see(index, seen, info)
        self.done[index], self.truncated[index] = done, truncated
        self._actions[index, self.steps[index]] = action
        self.steps[index] += 1

    def _see(self, index: int, seen: dict[str, np.ndarray], info: Mapping[str, Any]) -> None:
        self.observation[index], self.achieved_goal[index], self.desired_goal[index] = (
            seen[part] for part in _PARTS
        )
        said = [bool(info[key]) for key in _SUCCESS_KEYS if key in info]
        self.success[index] = bool(said) and said[0]

    @property
    def settled(self) -> np.ndarray:
        """(N,) bool: as ``success``; a foreign environment tells no more."""
        return self.success

    @property
    def hopeless(self) -> np.ndarray:
        """(N,) bool: False; a foreign environment ends such an episode itself."""
        return np.zeros(self.count, bool)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Return the environment's own reward for (n, G) goals, (n,) float32."""
        env: Any = self._envs[0].unwrapped
        # A GoalEnv need not know what to do with more than one row.
        rows = zip(achieved_goal, desired_goal, strict=True)
        rewards = [env.compute_reward(*row, {}) for row in rows]
        return np.array(rewards, np.float32).reshape(len(achieved_goal))

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return all that ``restore_snapshot`` needs: seeds and actions, for nothing else is
        common to all simulators."""
        return {
            "seeds": self._seeds.copy(),
            "steps": self.steps.copy(),
            "actions": self._actions.copy(),
        }

    def restore_snapshot(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from a snapshot, by doing again what was done since each reset."""
        self.reset(arrays["seeds"])
        for index, steps in enumerate(arrays["steps"]):
            for action in arrays["actions"][index, :steps]:
                self._step(index, action)

    def close(self) -> None:
        """Free the environments."""
        for env in self._envs:
            env.close()


AnyWorlds = Worlds | GymWorlds


def _make(env_id: str) -> gymnasium.Env[Any, Any]:
    """Return the environment; its module may stand before its id, as in ``my_package:MyEnv-v0``."""
    with contextlib.redirect_stderr(io.StringIO()):  # it greets with news of other environments
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    try:
        return gymnasium.make(env_id, disable_env_checker=True)
    except ModuleNotFoundError as error:
        raise ConfigError(f"--env.id {env_id}: {error}") from None
    except gymnasium.error.Error as error:
        raise ConfigError(
            f"--env.id {env_id}: {error} Give the id of a registered GoalEnv, for example "
            "FetchPickAndPlace-v4, or MODULE:ID for one that MODULE registers"
        ) from None


def _check(env: gymnasium.Env[Any, Any], env_id: str) -> tuple[list[int], spaces.Box]:
    """Return the sizes of the parts and the action space; ConfigError unless all are flat."""
    space, action_space = env.observation_space, env.action_space
    parts = space.spaces if isinstance(space, spaces.Dict) else {}
    shapes = [
        part.shape if isinstance(part := parts.get(name), spaces.Box) else None for name in _PARTS
    ]
    dims = [shape[0] for shape in shapes if shape is not None and len(shape) == 1]
    if len(dims) < len(_PARTS):
        raise ConfigError(
            f"--env.id {env_id}: not a GoalEnv with flat arrays; its observation needs the "
            f"parts {', '.join(_PARTS)}, each a one-dimensional Box, and is {space}"
        )
    if not isinstance(action_space, spaces.Box) or len(action_space.shape) != 1:
        raise ConfigError(
            f"--env.id {env_id}: its action must be a one-dimensional Box, and is {action_space}"
        )
    if not np.isfinite([action_space.low, action_space.high]).all():
        raise ConfigError(f"--env.id {env_id}: its action has no bounds: {action_space}")
    if env.spec is None or not env.spec.max_episode_steps:
        raise ConfigError(
            f"--env.id {env_id}: episodes have no limit; register it with max_episode_steps"
        )
    return dims, action_space
