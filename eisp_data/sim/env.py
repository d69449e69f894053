"""The Gymnasium front: one world of a task as a ``GoalEnv``."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium_robotics.core import GoalEnv

from eisp_data.errors import ConfigError
from eisp_data.sim.render import Renderer, check_camera
from eisp_data.sim.scene import CONTROL_HZ
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import compute_reward
from eisp_data.tasks.registry import get_task


class TaskEnv(GoalEnv):
    """The batched worlds with N = 1.

    Observations are ``{"observation": (S,), "achieved_goal": (G,), "desired_goal": (G,)}``
    float32, actions (4,) float32 in [-1, 1]. ``info`` holds ``is_success``. An episode never ends
    by itself: ``gymnasium.make`` cuts it after the task's L steps, or ``max_episode_steps``.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["rgb_array"],
        "render_fps": CONTROL_HZ,
    }

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        camera: str = "front",
        width: int = 480,
        height: int = 360,
    ) -> None:
        """Prepare a world; call ``reset`` first.

        Args:
            task: a name of the task registry.
            render_mode: ``rgb_array`` or None.
            camera: from where ``render`` looks, ``front``, ``top`` or ``shoulder``.
            width: of a frame, pixels.
            height: of a frame, pixels.

        Raises:
            ConfigError: no such task, render mode or camera.
        """
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ConfigError(f"unknown render_mode {render_mode!r}; choose one of {modes} or None")
        self.task = get_task(task)
        check_camera(self.task, camera)
        self.render_mode = render_mode
        self.worlds = Worlds(self.task, 1, threads=1)
        self._renderer: Renderer | None = None
        self._open_renderer = partial(Renderer, self.task, camera, width, height)
        dims = self.task.paper
        self.action_space = spaces.Box(-1.0, 1.0, (dims.action_dim,), np.float32)
        self.observation_space = spaces.Dict(
            observation=_unbounded(dims.observation_dim),
            achieved_goal=_unbounded(dims.goal_dim),
            desired_goal=_unbounded(dims.goal_dim),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode: that of ``Worlds.reset([seed])``, or the next of this env's own."""
        super().reset(seed=seed, options=options)
        world_seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self.worlds.reset([world_seed])
        return self._observation(), self._info()

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Apply a (4,) action for one control period."""
        self.worlds.step(np.asarray(action, np.float32)[None])
        observation, info = self._observation(), self._info()
        goals = observation["achieved_goal"], observation["desired_goal"]
        return (
            observation,
            float(self.compute_reward(*goals, info)),
            bool(self.compute_terminated(*goals, info)),
            bool(self.compute_truncated(*goals, info)),
            info,
        )

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any
    ) -> np.ndarray:
        """Return the paper's Eq. (1) for (..., G) goals, (...) float32."""
        return compute_reward(achieved_goal, desired_goal)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any
    ) -> np.ndarray:
        """Return (...) False for (..., G) goals: the blocks have to stay where they belong."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)

    def compute_truncated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any
    ) -> np.ndarray:
        """Return (...) False for (..., G) goals: the ``TimeLimit`` wrapper cuts episodes."""
        return np.zeros(np.shape(achieved_goal)[:-1], bool)

    def render(self) -> np.ndarray | None:
        """Return the current (H, W, 3) uint8 frame with the goals in it, None without a mode."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = self._open_renderer()
        return self._renderer.render(self.worlds.state[0], self.worlds.desired_goal[0])

    def close(self) -> None:
        """Free what rendering needed."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderer": None}

    def _observation(self) -> dict[str, np.ndarray]:
        return {
            "observation": self.worlds.observation[0],
            "achieved_goal": self.worlds.achieved_goal[0],
            "desired_goal": self.worlds.desired_goal[0].copy(),
        }

    def _info(self) -> dict[str, Any]:
        return {"is_success": bool(self.worlds.success[0])}


def _unbounded(dim: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (dim,), np.float32)
