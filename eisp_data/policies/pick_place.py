"""Picking a block up and placing it: the keyframes that Stack and Store share."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.script import CLOSED, OPEN, Aim, Keyframe, View
from eisp_data.sim.scene import BLOCK_SIZE_M

_FINGER_BELOW_M = 0.014
"""The fingertips end this far below the point between them."""
_CLEARANCE_M = 0.02
_TIPS_CLEAR_M = BLOCK_SIZE_M / 2 + _FINGER_BELOW_M + 0.014
"""From a block's centre to where the fingertips pass over it."""


def lifted(position: np.ndarray, height_m: float) -> np.ndarray:
    """Return the position with its z replaced, (3,)."""
    return np.array([position[0], position[1], height_m])


def pick(view: View, aim: Aim, block: int, height_m: float) -> Iterator[Keyframe]:
    """Go over the block at a height that clears everything, grasp it."""
    over = view.blocks[block]
    approach = over[2] + _TIPS_CLEAR_M
    if height_m > approach + 0.02:
        yield Keyframe(lifted(over, height_m), OPEN, tolerance_m=0.03)
    yield Keyframe(lifted(over, approach), OPEN, tolerance_m=0.012)
    grasp = aim.at(view.blocks[block])
    yield Keyframe(grasp, OPEN, tolerance_m=0.008)
    yield Keyframe(grasp, CLOSED, tolerance_m=0.015, hold_steps=2, most_steps=5)


def place(view: View, aim: Aim, target: np.ndarray, height_m: float) -> Iterator[Keyframe]:
    """Carry the held block over the target at a height that clears everything, set it down."""
    target = aim.destination(target)
    yield Keyframe(lifted(view.gripper, height_m), CLOSED, tolerance_m=0.015)
    yield Keyframe(lifted(target, height_m), CLOSED, tolerance_m=0.010)
    yield Keyframe(target + [0, 0, 0.003], CLOSED, tolerance_m=0.006)
    yield Keyframe(target + [0, 0, 0.003], OPEN, tolerance_m=0.02, hold_steps=1, most_steps=3)
    yield Keyframe(target + [0, 0, _TIPS_CLEAR_M], OPEN, tolerance_m=0.012)


def carry_height(view: View, without: int, target: np.ndarray) -> float:
    """Return the height at which a held block passes over every other block and the target."""
    others = np.delete(view.blocks, without, axis=0)
    top = max(others[:, 2].max(initial=0.0), target[2] - BLOCK_SIZE_M) + BLOCK_SIZE_M / 2
    return top + BLOCK_SIZE_M / 2 + _CLEARANCE_M
