"""The script of Stack: from the ground up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.pick_place import carry_height, pick, place
from eisp_data.policies.script import Aim, Keyframe, View
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.placement import scatter

_MISPLACED_M = 0.02
_ATTEMPTS = 8
_FREE_M = 0.09


def stack(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Build the tower; a demonstrator builds a part of it, and others at places of its own."""
    if not aim.noise.partial:
        yield from _build(view, aim, view.goal)
        return
    if aim.rng.random() < aim.noise.whole_share:
        yield from _build(view, aim, view.goal)
    elif aim.rng.random() < 0.5:
        yield from _build(view, aim, view.goal[: aim.rng.integers(1, len(view.goal))])
    while view.time_s < aim.noise.least_s:
        offset = np.append(_free_place(view, aim, view.goal[:1, :2]) - view.goal[0, :2], 0.0)
        yield from _build(view, aim, view.goal + offset)


def _build(view: View, aim: Aim, tower: np.ndarray) -> Iterator[Keyframe]:
    """Place the lowest block that is not where it belongs, until all are; tower is (levels, 3)."""
    for _ in range(_ATTEMPTS):
        errors = np.linalg.norm(view.blocks[: len(tower)] - tower, axis=1)
        misplaced = np.flatnonzero(errors > _MISPLACED_M)
        if not len(misplaced):
            return
        block = int(misplaced[0])
        place_at = tower[block]
        obstacle = _obstacle(view, block, place_at)
        if obstacle is not None:
            block = obstacle
            place_at = np.append(_free_place(view, aim, tower[:1, :2]), BLOCK_SIZE_M / 2)
        height = carry_height(view, block, place_at)
        yield from pick(view, aim, block, height - 0.02)
        yield from place(view, aim, place_at, height)


def _obstacle(view: View, block: int, target: np.ndarray) -> int | None:
    """Return the highest block that stands on this one, or on its target, if there is any."""
    blocks = view.blocks
    for spot in (blocks[block] + [0, 0, BLOCK_SIZE_M], target):
        across = np.linalg.norm(blocks[:, :2] - spot[:2], axis=1) < BLOCK_SIZE_M * 0.9
        above = blocks[:, 2] > spot[2] - BLOCK_SIZE_M / 2
        across[block] = False
        if (across & above).any():
            return int(np.where(across & above, blocks[:, 2], -1.0).argmax())
    return None


def _free_place(view: View, aim: Aim, taken: np.ndarray) -> np.ndarray:
    return scatter(aim.rng, 1, _FREE_M, taken=np.vstack([view.blocks[:, :2], taken]))[0]
