"""Ways round obstacles: two trees of postures that grow towards each other (RRT-Connect)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.robot import JointLimits

IsAllowed = Callable[[np.ndarray], bool]

_STRIDE_RAD = 0.25
_CHECK_RAD = 0.04
"""Between postures that are looked at on a straight stretch."""
_TRIES = 400
_SHORTCUTS = 60


def plan(
    start: np.ndarray,
    goal: np.ndarray,
    limits: JointLimits,
    is_allowed: IsAllowed,
    seed: int = 0,
) -> np.ndarray:
    """Return waypoints (W, J) rad from start to goal; between two the way is straight and allowed.

    Args:
        start: (J,) rad, allowed or not: the arm is there.
        goal: (J,) rad.
        limits: of the joints.
        is_allowed: of a posture (J,).
        seed: of the random postures.

    Raises:
        RobotError: the goal is not allowed, or no way was found.
    """
    if not is_allowed(goal):
        raise RobotError("the planned posture is outside the workspace or collides")
    if _is_straight_way(start, goal, is_allowed):
        return np.stack([start, goal])
    rng = np.random.default_rng(seed)
    low, high = np.maximum(limits.position_low, -np.pi), np.minimum(limits.position_high, np.pi)
    trees = [_Tree(start), _Tree(goal)]
    for attempt in range(_TRIES):
        one, other = trees[attempt % 2], trees[1 - attempt % 2]
        added = one.grow(rng.uniform(low, high), is_allowed)
        if added is None:
            continue
        met = other.reach(one.postures[added], is_allowed)
        if met is not None:
            way = one.way_to(added) + other.way_to(met)[::-1]
            return _shortened(np.stack(way if one is trees[0] else way[::-1]), is_allowed, rng)
    raise RobotError("no way to the planned posture without a collision was found")


class _Tree:
    """Postures, each with the one it was reached from."""

    def __init__(self, root: np.ndarray) -> None:
        self.postures, self._parents = [root], [-1]

    def grow(self, towards: np.ndarray, is_allowed: IsAllowed) -> int | None:
        """Add one stride towards a posture (J,); return its number, None if it is not allowed."""
        nearest = int(np.argmin(np.linalg.norm(np.stack(self.postures) - towards, axis=1)))
        here = self.postures[nearest]
        longest = float(np.abs(towards - here).max())
        there = towards
        if longest > _STRIDE_RAD:
            there = here + (towards - here) * (_STRIDE_RAD / longest)
        if not _is_straight_way(here, there, is_allowed):
            return None
        self.postures.append(there)
        self._parents.append(nearest)
        return len(self.postures) - 1

    def reach(self, posture: np.ndarray, is_allowed: IsAllowed) -> int | None:
        """Stride towards a posture (J,) until it is reached; return its number, None if barred."""
        while True:
            added = self.grow(posture, is_allowed)
            if added is None or np.array_equal(self.postures[added], posture):
                return added

    def way_to(self, number: int) -> list[np.ndarray]:
        """Return the postures from the root to that one."""
        way = []
        while number >= 0:
            way.append(self.postures[number])
            number = self._parents[number]
        return way[::-1]


def _is_straight_way(start: np.ndarray, end: np.ndarray, is_allowed: IsAllowed) -> bool:
    count = int(np.ceil(np.abs(end - start).max() / _CHECK_RAD))
    shares = np.arange(1, count + 1) / max(count, 1)
    return all(is_allowed(start + share * (end - start)) for share in shares)


def _shortened(way: np.ndarray, is_allowed: IsAllowed, rng: np.random.Generator) -> np.ndarray:
    for _ in range(_SHORTCUTS):
        if len(way) < 3:
            break
        first, last = sorted(rng.choice(len(way), 2, replace=False))
        if last - first > 1 and _is_straight_way(way[first], way[last], is_allowed):
            way = np.concatenate([way[: first + 1], way[last:]])
    return way
