"""Push4: four blocks, pushed with closed fingers to four places on the table."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.scene import BLOCK_SIZE_M, table_scene
from eisp_data.tasks import paper
from eisp_data.tasks.base import Task
from eisp_data.tasks.placement import scatter
from eisp_data.tasks.ways import on_the_way

PUSH_LOW_M = (0.235, -0.145)
PUSH_HIGH_M = (0.385, 0.145)
"""Where blocks and goals lie: the pusher gets behind a block on every side."""

SEPARATION_M = 0.09
"""Between two blocks or two goals: the closed fingers fit between."""

_SHORTEST_PUSH_M = 0.06
_TANGLED_SHARE = 0.5
"""Share of the episodes in which a block may lie in another's way, or on its goal."""


class Push4(Task):
    """Each block belongs at its own place; some have to be pushed in a certain order.

    There is always an order in which straight pushes do it. In some of the episodes any order
    does; in the others a block stands in another's way until it is pushed to its own place.
    """

    name = "push4"
    instruction = "Push the four blocks to their targets."
    paper = paper.PUSH4
    blocks = 4
    fingers_closed = True

    @property
    def scene(self) -> str:
        """The table with four blocks."""
        return table_scene(self.blocks)

    def reset(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw four block positions, four targets and the gripper's position above them."""
        starts, goals = _arrangement(rng, self.blocks)
        on_table = np.full((self.blocks, 1), BLOCK_SIZE_M / 2)
        gripper = rng.uniform((0.26, -0.08, 0.10), (0.36, 0.08, 0.16))
        goal = np.hstack([goals, on_table]).ravel().astype(np.float32)
        return self.state_of(gripper, np.hstack([starts, on_table])), goal


def _arrangement(rng: np.random.Generator, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and goals, (blocks, 2) each, that pushes in some order can solve."""
    tangled = bool(rng.random() < _TANGLED_SHARE)
    while True:
        starts = scatter(rng, blocks, SEPARATION_M, PUSH_LOW_M, PUSH_HIGH_M)
        goals = draw_goals(rng, starts, tangled)
        if goals is not None:
            return starts, goals


def draw_goals(rng: np.random.Generator, starts: np.ndarray, tangled: bool) -> np.ndarray | None:
    """Draw a place for one block after the other, in a random order; None if one finds no room.

    Args:
        rng: the world's generator.
        starts: (B, 2) m.
        tangled: whether a block may lie in another's way, or at its place.

    Returns:
        (B, 2) m.

    A way keeps clear of where the blocks are when it is pushed: the earlier ones at their goals,
    the later ones at their starts. Untangled ways keep clear of every start and goal.
    """
    places = starts.copy()
    goals: dict[int, np.ndarray] = {}
    for block in rng.permutation(len(starts)):
        done = list(goals)
        others = np.delete(places, block, axis=0)
        if not tangled and done:
            others = np.vstack([others, starts[done]])
        candidates = rng.uniform(PUSH_LOW_M, PUSH_HIGH_M, (60, 2))
        length = np.linalg.norm(candidates - starts[block], axis=1)
        fits = length >= _SHORTEST_PUSH_M
        fits &= ~on_the_way(starts[block], candidates[:, None], others).any(axis=1)
        for other in done:
            fits &= np.linalg.norm(candidates - goals[other], axis=1) >= SEPARATION_M
            if not tangled:
                fits &= ~on_the_way(starts[other], goals[other], candidates)
        if not fits.any():
            return None
        goals[int(block)] = places[block] = candidates[np.argmax(fits)]
    return np.array([goals[block] for block in range(len(starts))])
