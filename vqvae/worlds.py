"""Worlds that are seen through a camera and a VQ-VAE."""

from __future__ import annotations

import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.sim.pixels import Pixels
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import GRIPPER_DIM, is_success
from eisp_data.tasks.images import IMAGE_TASKS, goal_state
from vqvae.config import VisionConfig
from vqvae.latents import encode, observe, see
from vqvae.model import VqVae


class ImageWorlds(Worlds):
    """N worlds of an image task.

    Of a camera image the places that are read off its latent, and the latent, are seen: that is the
    achieved goal, and of a picture of the goal the desired one. For the observation see
    ``vqvae.latents.observe``. Success and reward are those of the worlds themselves: Eq. (1) on the
    true places of block and handle, which the policy never sees.

    Attributes:
        place: (N, 6) float32, what the goal wants in metres.
        desired_goal: (N, seen_dim) float32.
    """

    def __init__(
        self, name: str, model: VqVae, config: VisionConfig, count: int, threads: int | None = None
    ) -> None:
        """Open a camera and prepare the worlds; call ``reset`` first."""
        self._image_task = IMAGE_TASKS[name]
        if config.task != self._image_task.name:
            raise ConfigError(f"{name}: the VQ-VAE was trained on {config.task!r}")
        super().__init__(self._image_task, count, threads)
        self._name, self._model = name, model
        self._pixels = Pixels(self.task, config.camera, *config.model.image_size)
        self.place = self.desired_goal
        self.desired_goal = np.zeros((count, model.seen_dim), np.float32)
        self._seen: np.ndarray | None = None

    def restore(
        self, state: np.ndarray, desired_goal: np.ndarray, worlds: np.ndarray | None = None
    ) -> None:
        """Put the named worlds (all, if left out) into (n, P) states with (n, 6) goals in m."""
        indices = np.arange(self.count) if worlds is None else np.asarray(worlds)
        self.state[indices] = state
        self.place[indices] = desired_goal
        self.steps[indices] = 0
        goals = np.stack([goal_state(self._image_task, goal) for goal in desired_goal])
        self.desired_goal[indices] = self._see(goals)
        self._seen = None

    def step(self, action: np.ndarray) -> None:
        """Apply (N, A) actions for one control period."""
        super().step(action)
        self._seen = None

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return all that ``restore_snapshot`` needs to go on from here."""
        return super().snapshot() | {"place": self.place.copy()}

    def restore_snapshot(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from a snapshot."""
        super().restore_snapshot(arrays)
        self.place, self._seen = arrays["place"].copy(), None

    def images(self) -> np.ndarray:
        """Return what the camera sees, (N, H, W, 3) uint8."""
        return self._pixels.draw(self.state)

    @property
    def name(self) -> str:
        """The image task's."""
        return self._name

    @property
    def observation(self) -> np.ndarray:
        """(N, 10 + 5 P + latent_dim) float32."""
        own = self.task.observe(self.state)[:, :GRIPPER_DIM]
        return observe(own, self.achieved_goal, self._model.places)

    @property
    def achieved_goal(self) -> np.ndarray:
        """(N, seen_dim) float32."""
        if self._seen is None:
            self._seen = self._see(self.state)
        return self._seen

    @property
    def success(self) -> np.ndarray:
        """(N,) bool: the paper's Eq. (1) holds now."""
        return is_success(self.task.achieved_goal(self.state), self.place)

    def _see(self, states: np.ndarray) -> np.ndarray:
        return see(self._model, encode(self._model, self._pixels.draw(states)))
