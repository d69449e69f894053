"""The Episode: the one shape in which a trajectory travels between the parts of the toolkit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from eisp_data.errors import DataError

Scalar = str | int | float | bool


@dataclass(frozen=True)
class Episode:
    """One trajectory of T actions and T + 1 observations.

    Row ``t`` of the length-T arrays is what happened between observation ``t`` and ``t + 1``.
    Positions are metres in the frame of the robot base, velocities m/s and rad/s.
    """

    observation: np.ndarray
    """(T + 1, S) float32: what the policy sees, the robot's own part first."""
    achieved_goal: np.ndarray
    """(T + 1, G) float32: phi(s), the goal that each observation would have reached."""
    desired_goal: np.ndarray
    """(G,) float32: the goal of the episode. A goal that changes starts a new episode."""
    action: np.ndarray
    """(T, A) float32, each component in [-1, 1]."""
    reward: np.ndarray
    """(T,) float32: the paper's Eq. (1) on observation t + 1."""
    done: np.ndarray
    """(T,) bool: the task itself ended here (Gymnasium's ``terminated``)."""
    truncated: np.ndarray
    """(T,) bool: the episode was cut here by a limit of time."""
    success: np.ndarray
    """(T + 1,) bool: whether each observation meets the desired goal, the first one included."""
    sim_state: np.ndarray
    """(T + 1, P) float64: MuJoCo's full physics state; P = 0 for a real robot."""
    seed: int
    """The seed that ``reset`` was given; -1 for a real robot."""
    info: Mapping[str, Scalar] = field(default_factory=lambda: MappingProxyType({}))
    """What is said of the episode as a whole: task, policy, noise, level, operator."""
    images: Mapping[str, np.ndarray] = field(default_factory=lambda: MappingProxyType({}))
    """Camera name to (T + 1, H, W, 3) uint8 RGB; empty unless rendered."""

    def __len__(self) -> int:
        """Return T, the number of actions."""
        return len(self.action)

    def __post_init__(self) -> None:
        steps, observations = len(self.action), len(self.action) + 1
        if steps == 0:
            raise DataError("an episode needs at least one action")
        expected = {
            "observation": (observations, 2, np.float32),
            "achieved_goal": (observations, 2, np.float32),
            "desired_goal": (self.achieved_goal.shape[-1], 1, np.float32),
            "action": (steps, 2, np.float32),
            "reward": (steps, 1, np.float32),
            "done": (steps, 1, np.bool_),
            "truncated": (steps, 1, np.bool_),
            "success": (observations, 1, np.bool_),
            "sim_state": (observations, 2, np.float64),
        }
        for name, (length, ndim, dtype) in expected.items():
            array = getattr(self, name)
            if array.ndim != ndim or len(array) != length or array.dtype != dtype:
                raise DataError(
                    f"{name}: expected {ndim} dimension(s), length {length}, {np.dtype(dtype)}; "
                    f"got shape {array.shape}, {array.dtype}"
                )
            if dtype != np.bool_ and not np.isfinite(array).all():
                row = int(np.argwhere(~np.isfinite(array))[0][0])
                raise DataError(f"{name}: not finite at row {row}")
        for camera, frames in self.images.items():
            if frames.shape[0] != observations or frames.shape[-1] != 3 or frames.dtype != np.uint8:
                raise DataError(
                    f"image {camera!r}: expected ({observations}, H, W, 3) uint8; "
                    f"got {frames.shape} {frames.dtype}"
                )
