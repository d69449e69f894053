"""OpenDrawer: push the block out of the drawer's way, then open the drawer by its handle."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.drawer import TRAVEL_M
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks import paper
from eisp_data.tasks.drawer import DrawerTask, handle_at

IN_WAY_LOW_M, IN_WAY_HIGH_M = (0.210, -0.045), (0.275, 0.045)
"""Where a block stands between the handle and the kerb."""

BESIDE_LOW_M, BESIDE_HIGH_M = (0.210, 0.125), (0.290, 0.160)
"""Where a block is clear of the drawer, on the left; mirrored on the right."""

_IN_WAY_SHARE = 0.85
_START_HIGH_M = (0.275, 0.145)
"""The pusher fits between a block that starts beside the drawer and the end of the workspace."""


def place_beside(rng: np.random.Generator, side: float) -> np.ndarray:
    """Draw a place (2,) beside the drawer's path: on the left (1) or the right (-1)."""
    return rng.uniform(BESIDE_LOW_M, BESIDE_HIGH_M) * [1.0, side]


class OpenDrawer(DrawerTask):
    """The block belongs beside the drawer, the handle where the drawer is fully open.

    Mostly the block stands between the handle and the kerb, where it jams the drawer; else it
    lies on the wrong side of the drawer.
    """

    name = "open_drawer"
    instruction = "Push the block out of the way and open the drawer."
    paper = paper.OPEN_DRAWER

    def reset(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw the block's position and its goal, and the gripper's position above them."""
        side = rng.choice([-1.0, 1.0])
        if rng.random() < _IN_WAY_SHARE:
            start = rng.uniform(IN_WAY_LOW_M, IN_WAY_HIGH_M)
        else:
            start = rng.uniform(BESIDE_LOW_M, _START_HIGH_M) * [1.0, -side]
        half = BLOCK_SIZE_M / 2
        goal = np.hstack([place_beside(rng, side), half, handle_at(TRAVEL_M)])
        gripper = rng.uniform((0.24, -0.10, 0.12), (0.36, 0.10, 0.20))
        state = self.state_of(gripper, np.append(start, half)[None], np.zeros(1))
        return state, goal.astype(np.float32)
