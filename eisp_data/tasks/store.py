"""Store: open the drawer, put the block in, close the drawer."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.drawer import TRAY_CENTRE_M
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks import paper
from eisp_data.tasks.drawer import DrawerTask, handle_at
from eisp_data.tasks.open_drawer import IN_WAY_HIGH_M, IN_WAY_LOW_M

_IN_WAY_SHARE = 0.15
_ASIDE_LOW_M, _ASIDE_HIGH_M = (0.210, 0.140), (0.330, 0.180)
"""Where open fingers fit between a block and the open drawer, on the left."""
_TRAY_SPREAD_M = 0.012
"""Open fingers fit between a block so far off the middle and the tray's sides."""


def place_aside(rng: np.random.Generator, side: float) -> np.ndarray:
    """Draw a place (2,) on the left (1) or right (-1) where a block can be grasped."""
    return rng.uniform(_ASIDE_LOW_M, _ASIDE_HIGH_M) * [1.0, side]


def place_in_tray(rng: np.random.Generator) -> np.ndarray:
    """Draw where a block lies in the closed drawer, (3,)."""
    spread = [_TRAY_SPREAD_M, _TRAY_SPREAD_M, 0.0]
    return np.array(TRAY_CENTRE_M) + rng.uniform(-1.0, 1.0, 3) * spread


class Store(DrawerTask):
    """The block belongs in the drawer, and the handle where the drawer is closed.

    The block starts beside the drawer's way, now and then in it.
    """

    name = "store"
    instruction = "Put the block into the drawer and close it."
    paper = paper.STORE

    def reset(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw the block's position and its place in the drawer, and the gripper's position."""
        side = rng.choice([-1.0, 1.0])
        if rng.random() < _IN_WAY_SHARE:
            start = rng.uniform(IN_WAY_LOW_M, IN_WAY_HIGH_M)
        else:
            start = place_aside(rng, side)
        goal = np.hstack([place_in_tray(rng), handle_at(0.0)])
        gripper = rng.uniform((0.24, -0.10, 0.12), (0.36, 0.10, 0.20))
        block = np.append(start, BLOCK_SIZE_M / 2)
        return self.state_of(gripper, block[None], np.zeros(1)), goal.astype(np.float32)
