"""The script of OpenDrawer: push the block aside, then pull the handle."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.drawer import opening_of, push_block, slide_drawer
from eisp_data.policies.push_plan import possible_pushes
from eisp_data.policies.script import Aim, Keyframe, View
from eisp_data.sim.drawer import PATH_HALF_WIDTH_M, TRAVEL_M
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.open_drawer import IN_WAY_HIGH_M, IN_WAY_LOW_M, place_beside

_SHUT_M = 0.02
_SHORTEST_PUSH_M = 0.06
_SHORTEST_SLIDE_M = 0.04
_AWAY_M, _AJAR_M = 0.07, 0.08
"""Near the goal of the block a demonstrator opens the drawer this far at most: what it does at
places of its own is not to be the task."""
_DRAWS = 40


def open_drawer(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Clear the drawer's way and open it; a demonstrator does a part, others at its own places."""
    goal = view.goal[0, :2]
    if not aim.noise.partial or aim.rng.random() < aim.noise.whole_share:
        yield from push_block(view, aim, goal)
        yield from slide_drawer(view, aim, opening_of(view.goal[1]))
    elif aim.rng.random() < 0.4:
        yield from push_block(view, aim, goal)
    if aim.noise.partial:
        yield from _own_parts(view, aim)


def _own_parts(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Do what is next from here, at places of one's own; never the whole task."""
    while view.time_s < aim.noise.least_s:
        if opening_of(view.objects[1]) < _SHUT_M:
            place = _own_place(view, aim.rng)
            if place is not None:
                yield from push_block(view, aim, place)
            elif _in_way(view.blocks[0]):
                return
        if not _in_way(view.blocks[0]):
            yield from slide_drawer(view, aim, _own_opening(view, aim.rng))
        elif opening_of(view.objects[1]) >= _SHUT_M:
            yield from slide_drawer(view, aim, 0.0)


def _own_place(view: View, rng: np.random.Generator) -> np.ndarray | None:
    """Draw a place (2,) that one push reaches, None if none is found.

    It is beside the drawer's way, or now and then in it, if the block is not there already.
    """
    block = view.blocks[0]
    for _ in range(_DRAWS):
        if _in_way(block) or rng.random() < 0.8:
            place = place_beside(rng, rng.choice([-1.0, 1.0]))
        else:
            place = rng.uniform(IN_WAY_LOW_M, IN_WAY_HIGH_M)
        far = np.linalg.norm(place - block[:2]) >= _SHORTEST_PUSH_M
        if far and any(possible_pushes(0, block[:2], place)):
            return place
    return None


def _own_opening(view: View, rng: np.random.Generator) -> float:
    """Draw how far to open a drawer that is shut; one that is open is often shut again."""
    now = opening_of(view.objects[1])
    away = np.linalg.norm(view.blocks[0, :2] - view.goal[0, :2]) >= _AWAY_M
    if now >= _SHUT_M and (rng.random() < 0.5 or not away):
        return 0.0
    if not away:
        return float(rng.uniform(_SHORTEST_SLIDE_M, _AJAR_M))
    while True:
        opening = TRAVEL_M if rng.random() < 0.6 else float(rng.uniform(0.0, TRAVEL_M))
        if abs(opening - now) >= _SHORTEST_SLIDE_M:
            return opening


def _in_way(block: np.ndarray) -> bool:
    return bool(abs(block[1]) < PATH_HALF_WIDTH_M + BLOCK_SIZE_M / 2)
