"""Moving the drawer, and the block before it: the keyframes that OpenDrawer and Store share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from eisp_data.policies.push4 import approach, braking, follow
from eisp_data.policies.push_plan import possible_pushes
from eisp_data.policies.script import CLOSED, Aim, Keyframe, View
from eisp_data.sim.drawer import BAR_HALF_M, HANDLE_CLOSED_M, HANDLE_GAP_M

_FINGER_HALF_M = 0.011
_HOOK_M, _OVER_M = 0.030, 0.070
"""Heights of the fingers that are behind the bar, and that pass over it and over a block."""
_BAR_BEFORE_M = BAR_HALF_M + _FINGER_HALF_M
_PANEL_BEHIND_M = HANDLE_GAP_M - _FINGER_HALF_M
"""From the middle of the bar to fingers that touch the bar, and that touch the front panel."""
_LOWERED_M = 0.03
_MISPLACED_M = 0.02
_PUSHES = 4
_FASTEST_PUSH_M = 0.026
"""A block that is pushed alone and far stays on the fingers at this displacement per step."""
_START_M, _SLOWEST_M, _ARRIVED_M = 0.008, 0.005, 0.004
_GLIDE_STEPS = 40


def opening_of(handle: np.ndarray) -> float:
    """Return how far the drawer with its handle at (3,) is open, metres."""
    return float(HANDLE_CLOSED_M[0] - handle[0])


def push_block(view: View, aim: Aim, place: np.ndarray) -> Iterator[Keyframe]:
    """Push the block along the table to its (2,) place."""
    for _ in range(_PUSHES):
        block = view.blocks[0, :2]
        if np.linalg.norm(place - block) < _MISPLACED_M:
            return
        push = next((push for push in possible_pushes(0, block, place) if push), None)
        if push is None:
            return
        push = replace(push, target=aim.destination(np.append(push.target, 0.0))[:2])
        yield from approach(view, push)
        if view.gripper[2] < _LOWERED_M:
            yield from follow(view, push, _FASTEST_PUSH_M)


def slide_drawer(view: View, aim: Aim, opening_m: float) -> Iterator[Keyframe]:
    """Bring the closed fingers down behind the bar; pull or push the drawer so far open."""
    handle = view.objects[1]
    pull = opening_m > opening_of(handle)
    touch = _BAR_BEFORE_M + 0.005 if pull else _PANEL_BEHIND_M - 0.005
    behind = aim.at(handle + [touch, 0.0, 0.0])
    if view.gripper[2] < _OVER_M - 0.02:
        yield Keyframe(_at(view.gripper, _OVER_M), CLOSED, tolerance_m=0.02)
    yield Keyframe(_at(behind, _OVER_M), CLOSED, tolerance_m=0.010)
    yield Keyframe(_at(behind, _HOOK_M), CLOSED, tolerance_m=0.012)
    end = HANDLE_CLOSED_M[0] - opening_m + (_BAR_BEFORE_M if pull else _PANEL_BEHIND_M)
    if pull:
        yield Keyframe(np.array([end, behind[1], _HOOK_M]), CLOSED, tolerance_m=0.006)
    else:
        yield from _glide(view, end)
    yield Keyframe(_at(view.gripper, _OVER_M), CLOSED, tolerance_m=0.02)


def _glide(view: View, end_x_m: float) -> Iterator[Keyframe]:
    """Move along x, gaining and losing speed so gently that a block in the tray stays there."""
    start = view.gripper
    for step in range(_GLIDE_STEPS):
        way = end_x_m - view.gripper[0]
        if abs(way) < _ARRIVED_M:
            break
        length = max(min(_START_M * (step + 1), braking(abs(way))), _SLOWEST_M)
        ahead = view.gripper[0] + np.copysign(length, way)
        yield Keyframe(np.array([ahead, start[1], _HOOK_M]), CLOSED, 0.0, most_steps=1)


def _at(position: np.ndarray, height_m: float) -> np.ndarray:
    return np.array([position[0], position[1], height_m])
