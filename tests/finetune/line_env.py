"""A GoalEnv of which everything is known: a point on a line, pushed by its one action.

With an even seed the point starts at its goal, with an odd one too far away to get there.
"""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium import spaces

STEPS = 10
STEP_M = 0.05
_TOLERANCE_M = 0.05


class Line(gymnasium.Env):
    """Goal and observation are (x, y); the action moves along x."""

    def __init__(self, over_after: int | None = None) -> None:
        part = spaces.Box(-10, 10, (2,), np.float64)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict({name: part for name in names})
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self._over_after = over_after
        self._taken = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._place = self.np_random.uniform(-1, 1, 2)
        self._goal = self._place + np.array([0.0, 0.0 if int(seed or 0) % 2 == 0 else 1.0])
        self._taken = 0
        return self._seen(), {"is_success": self._success()}

    def step(self, action):
        self._place = self._place + np.array([STEP_M * float(action[0]), 0.0])
        self._taken += 1
        over = self._over_after is not None and self._taken >= self._over_after
        return self._seen(), self._success() - 1.0, over, False, {"is_success": self._success()}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return (np.linalg.norm(achieved_goal - desired_goal, axis=-1) <= _TOLERANCE_M) - 1.0

    def _success(self) -> bool:
        return bool(np.linalg.norm(self._place - self._goal) <= _TOLERANCE_M)

    def _seen(self):
        return {
            "observation": self._place.copy(),
            "achieved_goal": self._place.copy(),
            "desired_goal": self._goal.copy(),
        }


gymnasium.register("PushedLine-v0", Line, max_episode_steps=STEPS)
gymnasium.register("ShortPushedLine-v0", Line, max_episode_steps=STEPS, kwargs={"over_after": 4})
