"""What fingers do to a block that they touch: it moves as far as it has to.

Blocks are slow and slide with friction, so a pushed one stays where it is left. This tells where a
block is that the camera cannot see, and where one is now that it saw a moment ago.
"""

from __future__ import annotations

import numpy as np

from eisp_data.sim.drawer import BAR_HALF_M, HANDLE_CLOSED_M, HANDLE_GAP_M, TRAVEL_M
from eisp_data.sim.scene import BLOCK_SIZE_M

_HALF = BLOCK_SIZE_M / 2
_FINGER_HALF_M = (0.011, 0.006)
"""Half the size of a finger along and across the hand (see ``eisp_data.sim.scene``)."""
_FINGER_BELOW_M, _FINGER_ABOVE_M = 0.014, 0.051
_STILL_M = 1e-6
_TAKES_ALONG = 0.7
"""Cosine of the angle to the touching side's normal within which friction takes a block along."""
_BAR_HALF_WIDTH_M, _BAR_TOP_M = 0.045, 0.044


def push_out(block: np.ndarray, tool: np.ndarray, opening_m: float, way: np.ndarray) -> np.ndarray:
    """Return the block's (4, 4) pose after the fingers have come where they are.

    Args:
        block: (4, 4) to the task, upright.
        tool: (4, 4) to the task.
        opening_m: between the fingertips.
        way: (3,) m, how the tool has moved to get here.
    """
    length = _norm(way[:2])
    height = block[2, 3] - tool[2, 3]
    apart = not -_FINGER_BELOW_M - _HALF < height < _FINGER_ABOVE_M + _HALF
    if length < _STILL_M or apart:
        return block
    direction = way[:2] / length
    moved = block.copy()
    for side in (-1, 1):
        offset_m = side * (opening_m / 2 + _FINGER_HALF_M[1])
        moved[:2, 3] += _shift(moved, tool, offset_m, direction)
    # Fingers push no further than they have come.
    shift = moved[:2, 3] - block[:2, 3]
    moved[:2, 3] = block[:2, 3] + shift * min(1.0, length / max(_norm(shift), _STILL_M))
    return moved


def _shift(
    block: np.ndarray, tool: np.ndarray, offset_m: float, direction: np.ndarray
) -> np.ndarray:
    """Return how a block has to move to be clear of one finger that comes along (2,); (2,) m.

    The separating axes of two rectangles are their sides' directions; along the one on which they
    overlap least they touch. A finger that comes more or less straight takes the block along, one
    that slips past it, as fingers do that close while the arm moves, only pushes it aside.
    """
    hand = _flat(tool[:2, :2].T)
    finger = tool[:2, 3] + offset_m * hand[1]
    # An upright cube may stand on any face: its sides' normals are its two flattest axes.
    cube = _flat(block[:2, np.argsort(np.abs(block[2, :3]))[:2]].T)
    apart = block[:2, 3] - finger
    least, normal = np.inf, np.zeros(2)
    for axis in (*hand, *cube):
        reach = _HALF * np.abs(cube @ axis).sum() + np.abs(hand @ axis) @ _FINGER_HALF_M
        distance = float(apart @ axis)
        if reach - abs(distance) < least:
            least, normal = reach - abs(distance), np.sign(distance) * axis
    along = float(direction @ normal)
    if least <= 0.0 or along <= 0.0:
        return np.zeros(2)
    return least / along * direction if along > _TAKES_ALONG else least * normal


def _norm(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def _flat(axes: np.ndarray) -> np.ndarray:
    """Return horizontal axes (2, 2), as rows, with length 1."""
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def drag_drawer(opening_m: float, before: np.ndarray, tool: np.ndarray) -> float:
    """Return how far the drawer is open after closed fingers have come where they are.

    Fingers between the bar and the front keep to that gap, and take it along.

    Args:
        opening_m: before.
        before: (4, 4), the tool's pose to the task then.
        tool: (4, 4), the same now.
    """
    x, y, z = tool[:3, 3]
    low = z - _FINGER_BELOW_M < _BAR_TOP_M and abs(y) < _BAR_HALF_WIDTH_M
    bar = HANDLE_CLOSED_M[0] - opening_m
    if not low or not bar < before[0, 3] < bar + HANDLE_GAP_M:
        return opening_m
    least = HANDLE_CLOSED_M[0] + BAR_HALF_M - (x - _FINGER_HALF_M[0])
    most = HANDLE_CLOSED_M[0] + HANDLE_GAP_M - (x + _FINGER_HALF_M[0])
    return float(np.clip(np.clip(opening_m, least, most), 0.0, TRAVEL_M))
