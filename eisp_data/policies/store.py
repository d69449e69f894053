"""The script of Store: open the drawer, put the block in, close the drawer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.drawer import opening_of, slide_drawer
from eisp_data.policies.pick_place import pick, place
from eisp_data.policies.script import OPEN, Aim, Keyframe, View
from eisp_data.sim.drawer import PATH_HALF_WIDTH_M, TRAVEL_M
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.store import place_aside, place_in_tray

_CARRY_M = 0.085
"""A held block passes over the tray's sides."""
_IN_WAY_M = PATH_HALF_WIDTH_M + BLOCK_SIZE_M / 2
_ASIDE_M = 0.145
_TRAY_FLOOR_M = 0.030
"""A block that lies in the tray is higher than this; one on the table is not."""
_WIDE_OPEN_M = 0.130
_SHUT_M = 0.02
_ATTEMPTS = 3
_WHOLE_IN_WAY = 4
"""How much more often the whole task is shown where it begins with a block in the way, which it
seldom does: nothing else shows that the block comes first then, and goes where it does not belong.
"""


def store(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Put the block away; a demonstrator does a part of it, others at places of its own."""
    share = aim.noise.whole_share * (_WHOLE_IN_WAY if _in_way(view) else 1)
    whole = not aim.noise.partial or aim.rng.random() < share
    if whole:
        yield from _put_away(view, aim)
    while aim.noise.partial and view.time_s < aim.noise.least_s:
        if whole:
            yield Keyframe(view.gripper, OPEN)
        else:
            yield from _own_part(view, aim)


def _put_away(view: View, aim: Aim) -> Iterator[Keyframe]:
    for _ in range(_ATTEMPTS):
        if not _in_tray(view):
            yield from _clear(view, aim)
            if _opening(view) < _WIDE_OPEN_M:
                yield from slide_drawer(view, aim, TRAVEL_M)
            yield from _carry(view, aim, _in_open_tray(view, view.goal[0]))
        if _in_tray(view):
            yield from slide_drawer(view, aim, 0.0)
            return


def _clear(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Put the block out of the drawer's way if it is in it.

    It is carried: pushed, it may end up where the gripper does not come.
    """
    x, y = view.blocks[0, :2]
    if _in_way(view):
        aside = np.array([x, np.copysign(_ASIDE_M, y), BLOCK_SIZE_M / 2])
        yield from _carry(view, aim, aside)


def _carry(view: View, aim: Aim, target: np.ndarray) -> Iterator[Keyframe]:
    """Pick the block up and put it at (3,)."""
    yield from pick(view, aim, 0, _CARRY_M)
    yield from place(view, aim, target, _CARRY_M)


def _own_part(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Do what is next from here, at a place of one's own; never the whole task."""
    rng = aim.rng
    inside, wide_open = _in_tray(view), _opening(view) >= _WIDE_OPEN_M
    if inside and not wide_open:
        yield from slide_drawer(view, aim, TRAVEL_M)
    elif inside and rng.random() < 0.7:
        # Half shut: a drawer that is shut with the block inside is the whole task.
        yield from slide_drawer(view, aim, rng.uniform(0.075, 0.115))
    elif wide_open and not inside and rng.random() < 0.7:
        yield from _carry(view, aim, _in_open_tray(view, place_in_tray(rng)))
    elif inside or rng.random() < 0.3:
        aside = place_aside(rng, rng.choice([-1.0, 1.0]))
        yield from _carry(view, aim, np.append(aside, BLOCK_SIZE_M / 2))
    elif _opening(view) < _SHUT_M:
        yield from _clear(view, aim)
        opening = TRAVEL_M if rng.random() < 0.7 else rng.uniform(0.05, TRAVEL_M)
        yield from slide_drawer(view, aim, opening)
    else:
        yield from slide_drawer(view, aim, 0.0)


def _in_way(view: View) -> bool:
    return bool(abs(view.blocks[0, 1]) < _IN_WAY_M)


def _opening(view: View) -> float:
    return opening_of(view.objects[1])


def _in_tray(view: View) -> bool:
    block = view.blocks[0]
    return bool(block[2] > _TRAY_FLOOR_M and abs(block[1]) < PATH_HALF_WIDTH_M)


def _in_open_tray(view: View, in_closed: np.ndarray) -> np.ndarray:
    """Return where a place in the closed drawer is now, (3,)."""
    return in_closed - [_opening(view), 0.0, 0.0]
