"""Which block to push next, whereto and from which side, among blocks that stand in the way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from eisp_data.sim.scene import BLOCK_SIZE_M, WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from eisp_data.tasks.push4 import PUSH_HIGH_M, PUSH_LOW_M
from eisp_data.tasks.ways import WAY_HALF_WIDTH_M, on_the_way

PUSHER_HALF_M = 0.012
"""Half the edge of the two closed fingers, seen from above."""
BESIDE_M = BLOCK_SIZE_M / 2 + PUSHER_HALF_M
"""Between the centres of a block and of a pusher that touches it."""

_GAP_M = 0.010
"""Room to set the fingers down behind a block that may have turned."""
_MARGIN_M = 0.003
_OFF_CENTRE_M = 0.014
"""How far the pusher may stand off the middle of a face and still rest on it."""
_STEEPEST = 1.3
"""Tangent of the steepest push against a face; pads hold by friction up to 1.5."""
_GRID_STEP_M = 0.03


@dataclass(frozen=True)
class Push:
    """One straight push."""

    block: int
    target: np.ndarray
    """(2,) m, where the block's centre should end."""
    normal: np.ndarray
    """(2,) unit vector along x or y, from the pusher into the face."""
    stand: np.ndarray
    """(2,) m, where the closed fingers come down behind the block."""


def choose_push(blocks: np.ndarray, targets: np.ndarray, misplaced: np.ndarray) -> Push | None:
    """Return the first push of a sequence that brings every block home.

    Blocks go in the order of their numbers as far as they do not obstruct each other; a block
    that has no straight way steps aside first.

    Args:
        blocks: (B, 2) m.
        targets: (B, 2) m.
        misplaced: (B,) bool; the others are not pushed.
    """
    todo = tuple(int(block) for block in np.flatnonzero(misplaced))
    if not todo:
        return None
    order = _order(blocks, targets, todo)
    if order is not None:
        return _straight(blocks, order[0], targets[order[0]])
    for block, place in _asides(blocks, targets, todo):
        push = _straight(blocks, block, place)
        if push is None:
            continue
        moved = blocks.copy()
        moved[block] = place
        if _order(moved, targets, todo) is not None:
            return push
    pushes = [_straight(blocks, block, targets[block]) for block in todo]
    return next((push for push in pushes if push), None) or _forced(blocks, todo[0], targets)


def possible_pushes(block: int, start: np.ndarray, end: np.ndarray) -> list[Push | None]:
    """Return the push from each of two faces, best first, were the block alone on the table.

    Args:
        block: its number.
        start: (2,) m, the centre of the block.
        end: (2,) m.

    Returns:
        None for a face that the pusher cannot get behind, or that it would slip along.
    """
    pushes: list[Push | None] = []
    for normal in _normals(end - start):
        stand = _stand(start, end, normal)
        inside = (stand >= WORKSPACE_LOW_M[:2]).all() and (stand <= WORKSPACE_HIGH_M[:2]).all()
        possible = inside and _slope(end - start, normal) <= _STEEPEST
        pushes.append(Push(block, end, normal, stand) if possible else None)
    return pushes


def way_for_pusher(start: np.ndarray, end: np.ndarray, blocks: np.ndarray) -> bool:
    """Return whether the lowered fingers can go straight from here to there."""
    half = np.minimum(BESIDE_M + _MARGIN_M, _apart(start, blocks) - 1e-3)
    return not on_the_way(start, end, blocks, half[:, None]).any()


def is_behind(pusher: np.ndarray, block: np.ndarray, normal: np.ndarray) -> bool:
    """Return whether a pusher at (2,) is still behind the face of the block that it pushes."""
    offset = block - pusher
    aside = np.abs(offset - (offset @ normal) * normal).max()
    return bool(offset @ normal > 0.7 * BESIDE_M and aside < 0.8 * BESIDE_M)


def _order(blocks: np.ndarray, targets: np.ndarray, todo: tuple[int, ...]) -> list[int] | None:
    """Return an order of straight pushes, by number where there is a choice; None if none works."""
    obstacles = {
        block: _obstacles(blocks[block], targets[block], np.concatenate([blocks, targets]), block)
        for block in todo
    }
    count = len(blocks)

    @cache
    def finish(left: tuple[int, ...]) -> list[int] | None:
        if not left:
            return []
        where = np.array([j if j in left or j not in todo else count + j for j in range(count)])
        for block in left:
            if (~obstacles[block][:, where].any(axis=1)).any():
                rest = finish(tuple(j for j in left if j != block))
                if rest is not None:
                    return [block, *rest]
        return None

    return finish(todo)


def _straight(blocks: np.ndarray, block: int, target: np.ndarray) -> Push | None:
    """Return the push that takes the block straight there, None if something is in the way."""
    obstacles = _obstacles(blocks[block], target, blocks, block)
    for face, normal in enumerate(_normals(target - blocks[block])):
        if not obstacles[face].any():
            return Push(block, target, normal, _stand(blocks[block], target, normal))
    return None


def _forced(blocks: np.ndarray, block: int, targets: np.ndarray) -> Push:
    normal = _normals(targets[block] - blocks[block])[0]
    stand = _stand(blocks[block], targets[block], normal)
    return Push(block, targets[block], normal, stand)


def _asides(
    blocks: np.ndarray, targets: np.ndarray, todo: tuple[int, ...]
) -> list[tuple[int, np.ndarray]]:
    """Return (block, place) pairs, short detours on the way to the block's own target first."""
    pairs = [
        (block, place)
        for block in todo
        for place in _grid()
        if np.linalg.norm(place - blocks[block]) >= _GRID_STEP_M
    ]

    def detour(pair: tuple[int, np.ndarray]) -> float:
        block, place = pair
        way = np.linalg.norm(place - blocks[block]) + np.linalg.norm(targets[block] - place)
        return float(way - np.linalg.norm(targets[block] - blocks[block]))

    return sorted(pairs, key=detour)


@cache
def _grid() -> list[np.ndarray]:
    x = np.arange(PUSH_LOW_M[0], PUSH_HIGH_M[0] + 1e-9, _GRID_STEP_M)
    y = np.arange(PUSH_LOW_M[1], PUSH_HIGH_M[1] + 1e-9, _GRID_STEP_M)
    return list(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))


def _obstacles(start: np.ndarray, end: np.ndarray, places: np.ndarray, block: int) -> np.ndarray:
    """Return which places, were a block there, would obstruct a push from each of two faces.

    Args:
        start: (2,) m, the centre of the block.
        end: (2,) m.
        places: (P, 2) m; those of the block itself, every B-th from ``block``, do not count.
        block: its number.

    Returns:
        (2, P) bool; a face that cannot be used is obstructed by all.
    """
    others = np.arange(len(places)) % _BLOCKS != block
    half = np.minimum(WAY_HALF_WIDTH_M, _apart(start, places) - 1e-3)
    in_way = on_the_way(start, end, places, half[:, None]) & others
    result = np.ones((2, len(places)), bool)
    for face, push in enumerate(possible_pushes(block, start, end)):
        if push is not None:
            touching = push.stand + end - start
            hit = on_the_way(push.stand, touching, places, BESIDE_M + _MARGIN_M)
            result[face] = in_way | (hit & others)
    return result


_BLOCKS = 4


def _normals(way: np.ndarray) -> list[np.ndarray]:
    """Return the directions of the two faces that a push along (2,) could use, best first."""
    along_x = np.array([np.copysign(1.0, way[0]), 0.0])
    along_y = np.array([0.0, np.copysign(1.0, way[1])])
    return [along_x, along_y] if abs(way[0]) >= abs(way[1]) else [along_y, along_x]


def _slope(way: np.ndarray, normal: np.ndarray) -> float:
    along = float(way @ normal)
    return float(np.linalg.norm(way - along * normal)) / max(along, 1e-9)


def _stand(centre: np.ndarray, target: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return where the pusher comes down: so that its push goes through the block's centre."""
    way = target - centre
    along = max(float(way @ normal), 1e-9)
    off = -(way - along * normal) / along * BLOCK_SIZE_M / 2
    off = np.clip(off, -_OFF_CENTRE_M, _OFF_CENTRE_M)
    return centre - normal * (BESIDE_M + _GAP_M) + off


def _apart(point: np.ndarray, places: np.ndarray) -> np.ndarray:
    return np.abs(places - point).max(axis=-1)
