"""What OpenDrawer and Store share: one block, and a drawer whose handle is part of the goal."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.drawer import HANDLE_CLOSED_M, drawer_scene
from eisp_data.tasks.base import AT_REST_M_S, GRIPPER_DIM, OBJECT_DIM, ObjectSlot, Task

_DRAWER = 5
"""Index of the drawer's slide in qpos and qvel."""


def handle_at(opening_m: float) -> np.ndarray:
    """Return the position (3,) of the handle of a drawer that is so far open."""
    return np.array(HANDLE_CLOSED_M) - [opening_m, 0.0, 0.0]


class DrawerTask(Task):
    """Goal ``[block 3, handle 3]``, observation ``[gripper, block, handle, slide 2]``."""

    blocks = 1
    fixtures = 1

    @property
    def scene(self) -> str:
        """The table with the drawer and one block."""
        return drawer_scene()

    @property
    def objects(self) -> tuple[ObjectSlot, ...]:
        """The block, then the handle."""
        handle = GRIPPER_DIM + OBJECT_DIM
        return (
            *super().objects,
            ObjectSlot("handle", slice(handle, handle + OBJECT_DIM), slice(3, 6)),
        )

    def extra_features(self, state: np.ndarray) -> list[np.ndarray]:
        """Return the handle's OBJECT_DIM features and the slide's position and velocity."""
        handle = self.handle_positions(state)
        slide_velocity = self.qvel(state)[:, _DRAWER : _DRAWER + 1]
        zeros = np.zeros_like(handle)  # it neither turns nor spins
        velocity = np.hstack([-slide_velocity, zeros[:, :2]])
        relative = handle - self.qpos(state)[:, :3]
        slide = np.hstack([self.openings(state)[:, None], slide_velocity])
        return [handle, relative, zeros, velocity, zeros, slide]

    def achieved_goal(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, 6) float32 positions of the block and of the handle."""
        block = self.block_positions(state)[:, 0]
        return np.hstack([block, self.handle_positions(state)]).astype(np.float32)

    def settled(self, state: np.ndarray) -> np.ndarray:
        """Return whether block and drawer are at rest and the block is not held, (N,) bool."""
        return super().settled(state) & (np.abs(self.qvel(state)[:, _DRAWER]) < AT_REST_M_S)

    def openings(self, state: np.ndarray) -> np.ndarray:
        """Return how far the drawers are open, (N,) metres."""
        return self.qpos(state)[:, _DRAWER]

    def handle_positions(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, 3) positions of the handles."""
        handle = np.tile(np.array(HANDLE_CLOSED_M), (len(state), 1))
        handle[:, 0] -= self.openings(state)
        return handle
