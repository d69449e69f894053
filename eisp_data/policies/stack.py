"""The script of Stack: from the ground up, as far as this demonstrator goes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from eisp_data.policies.pick_place import carry_height, pick, place
from eisp_data.policies.script import Aim, Keyframe, View

_MISPLACED_M = 0.02
_ATTEMPTS = 8


def stack(view: View, aim: Aim) -> Iterator[Keyframe]:
    """Place the lowest block that is not where it belongs, until all of this part are."""
    levels = aim.part(len(view.goal))
    for _ in range(_ATTEMPTS):
        errors = np.linalg.norm(view.blocks - view.goal, axis=1)[:levels]
        misplaced = np.flatnonzero(errors > _MISPLACED_M)
        if not len(misplaced):
            return
        block = int(misplaced[0])
        height = carry_height(view, block, view.goal[block])
        yield from pick(view, aim, block, height - 0.02)
        yield from place(view, aim, view.goal[block], height)
