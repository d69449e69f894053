"""The script of Push4: one block at a time, each with straight pushes through its centre."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from eisp_data.policies.push_plan import Push, choose_push, is_behind, way_for_pusher
from eisp_data.policies.script import CLOSED, Aim, Keyframe, View
from eisp_data.sim.scene import CONTROL_HZ
from eisp_data.tasks.push4 import draw_goals

_LOW_M, _OVER_M = 0.020, 0.080
"""Heights of the fingers that push, and that pass over the blocks."""
_CLEAR_M = 0.068
_LOWERED_M = 0.03
_MISPLACED_M, _ARRIVED_M = 0.015, 0.004
_PUSHES = 24
_PUSH_STEPS = 30
_DRAWS = 40
_FASTEST_M, _SLOWEST_M = 0.036, 0.005
"""Displacements commanded per step while pushing."""
_START_M = 0.014
"""A push begins this slowly and gains as much with each step: a block that is hit tumbles."""
_BRAKE_M_S2 = 5.0
"""The friction of the table stops a block at 6.9 m/s2: braked harder, it slides on by itself."""
_BACK_M = 0.012
_WAIT_STEPS = 25
"""Before looking anew for something to do, where blocks are jammed."""


def push4(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Push every block home; a demonstrator does a part of it, and others at places of its own."""
    goal = view.goal[:, :2]
    if not aim.noise.partial or aim.rng.random() < aim.noise.whole_share:
        yield from _arrange(view, aim, goal, len(goal))
    elif aim.rng.random() < 0.5:
        yield from _arrange(view, aim, goal, int(aim.rng.integers(1, len(goal))))
    while aim.noise.partial and view.time_s < aim.noise.least_s:
        own = _own_places(view, aim)
        if own is None:
            yield replace(_rise(view), hold_steps=_WAIT_STEPS)
        else:
            yield from _arrange(view, aim, own, len(own))
    yield _rise(view)


def _arrange(view: View, aim: Aim, targets: np.ndarray, most: int) -> Iterator[Keyframe]:
    """Push blocks to their (B, 2) places as far as they are not there, at most so many of them."""
    touched: set[int] = set()
    for _ in range(_PUSHES):
        blocks = view.blocks[:, :2]
        misplaced = np.linalg.norm(blocks - targets, axis=1) > _MISPLACED_M
        push = choose_push(blocks, targets, misplaced)
        if push is None or len(touched | {push.block}) > most:
            return
        touched.add(push.block)
        push = replace(push, target=aim.destination(np.append(push.target, 0.0))[:2])
        yield from approach(view, push)
        if view.gripper[2] < _LOWERED_M:
            yield from follow(view, push)


def _own_places(view: View, aim: Aim) -> np.ndarray | None:
    """Draw an arrangement (B, 2) that pushes can reach from here; None where blocks are jammed."""
    for _ in range(_DRAWS):
        tangled = bool(aim.rng.random() < 0.5)
        places = draw_goals(aim.rng, view.blocks[:, :2], tangled)
        if places is not None:
            return places
    return None


def approach(view: View, push: Push) -> Iterator[Keyframe]:
    """Bring the fingers down behind the block, along the table if nothing is in between."""
    if not (
        view.gripper[2] < _LOWERED_M
        and way_for_pusher(view.gripper[:2], push.stand, view.blocks[:, :2])
    ):
        if view.gripper[2] < _CLEAR_M:
            yield Keyframe(np.append(view.gripper[:2], _OVER_M), CLOSED, tolerance_m=0.012)
        yield Keyframe(np.append(push.stand, _OVER_M), CLOSED, tolerance_m=0.010)
    yield Keyframe(np.append(push.stand, _LOW_M), CLOSED, tolerance_m=0.008)


def follow(view: View, push: Push, fastest_m: float = _FASTEST_M) -> Iterator[Keyframe]:
    """Push, aiming anew at every step, until the block is there or slips off the fingers."""
    for step in range(_PUSH_STEPS):
        block = view.blocks[push.block, :2]
        left = push.target - block
        if left @ push.normal < _ARRIVED_M or not is_behind(view.gripper[:2], block, push.normal):
            break
        way = float(np.linalg.norm(left))
        length = min(_START_M * (step + 1), fastest_m, braking(way))
        ahead = view.gripper[:2] + left / way * max(length, _SLOWEST_M)
        yield Keyframe(np.append(ahead, _LOW_M), CLOSED, tolerance_m=0.0, most_steps=1)
    back = view.gripper[:2] - _BACK_M * push.normal
    yield Keyframe(np.append(back, _LOW_M), CLOSED, tolerance_m=0.0, most_steps=1)


def braking(way_m: float) -> float:
    """Return the longest next step after which the braking way still fits in what is left."""
    period = 1.0 / CONTROL_HZ
    speed = _BRAKE_M_S2 * (np.sqrt(period**2 + 2 * way_m / _BRAKE_M_S2) - period)
    return float(speed * period)


def _rise(view: View) -> Keyframe:
    return Keyframe(np.append(view.gripper[:2], _OVER_M), CLOSED)
