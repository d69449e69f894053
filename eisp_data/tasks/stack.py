"""Stack: three blocks, picked up and placed in sequence at the target."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.scene import BLOCK_SIZE_M, table_scene
from eisp_data.tasks import paper
from eisp_data.tasks.base import Task
from eisp_data.tasks.placement import scatter

_SEPARATION_M = 0.10
"""An open finger fits beside every block."""


class Stack(Task):
    """Block i belongs on level i of a tower at a random place; all start apart on the table."""

    name = "stack"
    instruction = "Stack the three blocks at the target."
    paper = paper.STACK
    blocks = 3

    @property
    def scene(self) -> str:
        """The table with three blocks."""
        return table_scene(self.blocks)

    def reset(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw three block positions, the tower's place and the gripper's position."""
        places = scatter(rng, self.blocks + 1, _SEPARATION_M)
        on_table = np.full((self.blocks, 1), BLOCK_SIZE_M / 2)
        blocks = np.hstack([places[:-1], on_table])
        goal = np.tile(np.append(places[-1], BLOCK_SIZE_M / 2), (self.blocks, 1))
        goal[:, 2] += BLOCK_SIZE_M * np.arange(self.blocks)
        gripper = rng.uniform((0.26, -0.08, 0.12), (0.36, 0.08, 0.20))
        return self.state_of(gripper, blocks), goal.ravel().astype(np.float32)
