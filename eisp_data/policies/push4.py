"""The script of Push4: one block at a time, each with straight pushes through its centre."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.push_plan import Push, choose_push, way_for_pusher
from eisp_data.policies.script import CLOSED, Aim, Keyframe, View

_LOW_M, _OVER_M = 0.020, 0.080
"""Heights of the fingers that push, and that pass over the blocks."""
_CLEAR_M = 0.068
_MISPLACED_M = 0.015
_PUSHES = 24
_FASTEST_M, _SLOWEST_M, _BRAKE = 0.040, 0.008, 0.6
"""Displacement commanded per step: in proportion to the way left, so that a block does not
slide on by itself."""


def push4(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Push every block home."""
    yield from _arrange(view, aim, view.goal[:, :2])


def _arrange(view: View, aim: Aim, targets: np.ndarray) -> Iterator[Keyframe]:
    """Push the first len(targets) blocks to their (n, 2) places, as far as they are not there."""
    for _ in range(_PUSHES):
        blocks = view.blocks[:, :2]
        misplaced = np.linalg.norm(blocks - targets, axis=1) > _MISPLACED_M
        push = choose_push(blocks, targets, misplaced)
        if push is None:
            return
        yield from _approach(view, push)
        yield from _follow(view, push)
    yield _rise(view)


def _approach(view: View, push: Push) -> Iterator[Keyframe]:
    """Bring the fingers down behind the block, along the table if nothing is in between."""
    low = view.gripper[2] < _LOW_M + 0.01
    if not (low and way_for_pusher(view.gripper[:2], push.stand, view.blocks[:, :2])):
        if view.gripper[2] < _CLEAR_M:
            yield Keyframe(np.append(view.gripper[:2], _OVER_M), CLOSED, tolerance_m=0.012)
        yield Keyframe(np.append(push.stand, _OVER_M), CLOSED, tolerance_m=0.010)
    yield Keyframe(np.append(push.stand, _LOW_M), CLOSED, tolerance_m=0.008)


def _follow(view: View, push: Push) -> Iterator[Keyframe]:
    """Push, aiming anew at every step, until the block is there or slips off the fingers."""
    for _ in range(40):
        left = push.target - view.blocks[push.block, :2]
        if left @ push.normal < 0.004:
            return
        distance = np.linalg.norm(left)
        step = np.clip(_BRAKE * distance, _SLOWEST_M, _FASTEST_M) / distance
        ahead = view.gripper[:2] + left * step
        yield Keyframe(np.append(ahead, _LOW_M), CLOSED, tolerance_m=0.0, most_steps=1)


def _rise(view: View) -> Keyframe:
    return Keyframe(np.append(view.gripper[:2], _OVER_M), CLOSED)
