"""An external hand that undoes what the robot has done, as in the paper's robustness test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from eisp_data.robots.record_controllers import Decision
from eisp_data.robots.session_view import Seen
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.base import Task

if TYPE_CHECKING:
    from eisp_data.robots.twin.referee import Referee

_DONE_M = 0.035
"""A block this near to its place is done: two objects may each be so far off in a success."""
_CLEAR_M = 0.05
"""The hand takes a block from which the gripper is this far away, and puts it down"""
_APART_M = 0.09
"""this far from all other blocks and goals, and from the gripper."""
_REST_TICKS = 5
_TURN_RAD = 0.2
_DRAWS = 200
_SHUT_M = 0.02


class Hand:
    """Takes one block away in each episode, once it, and as many as were drawn, are in place.

    Where all objects together meet the goal, all blocks are.

    Attributes:
        moved: whether it has done so in this episode.
    """

    def __init__(self, referee: Referee, task: Task) -> None:
        self._referee, self._task = referee, task
        self._rng = np.random.default_rng(0)
        self._whole_goal: np.ndarray = np.empty(0)
        self._goal: np.ndarray = np.empty((0, 3))
        self._after = self._rest = 0
        self._given = np.empty(0, bool)
        self.moved = False

    def begin(self, goal: np.ndarray, seed: int) -> None:
        """Draw after how many subtasks the hand comes; the table is set already."""
        self._rng = np.random.default_rng([seed, 3])
        self._whole_goal = goal
        self._goal = goal.reshape(-1, 3)[: self._task.blocks].astype(float)
        self._given = self._done(self._referee.state())
        self._after = int(self._rng.integers(1, self._task.blocks + 1))
        self._rest, self.moved = 0, False

    def __call__(self, step: int, seen: Seen, decision: Decision) -> None:
        """Watch a tick of the session, and move a block when it is time."""
        if self.moved:
            return
        state = self._referee.state()
        done = self._done(state) & ~self._given
        if self._referee.success(self._whole_goal):
            # By the task's own measure all of it is done, also what is a little further off.
            done[:] = True
        quiet = done.sum() >= self._after and bool(self._task.settled(state[None])[0])
        self._rest = self._rest + 1 if quiet else 0
        if self._rest < _REST_TICKS:
            return
        block = self._choose(state, done)
        place = None if block is None else self._free_place(state, block)
        if block is not None and place is not None:
            turn = float(self._rng.uniform(-_TURN_RAD, _TURN_RAD))
            self._referee.move_block(block, place, turn)
            self.moved = True

    def _done(self, state: np.ndarray) -> np.ndarray:
        """Return which blocks are in place, (blocks,) bool."""
        blocks = self._task.block_positions(state[None])[0]
        return np.linalg.norm(blocks - self._goal, axis=1) < _DONE_M

    def _choose(self, state: np.ndarray, done: np.ndarray) -> int | None:
        """Return one that is in place, has nothing on it and is out of the gripper's reach."""
        blocks = self._task.block_positions(state[None])[0]
        gripper = self._task.qpos(state)[:3]
        free = []
        for index in np.flatnonzero(done):
            away = blocks - blocks[index]
            beside = np.abs(away[:, :2]).max(axis=1) < BLOCK_SIZE_M
            covered = (beside & (away[:, 2] > BLOCK_SIZE_M / 2)).any()
            if not covered and np.linalg.norm(gripper - blocks[index]) > _CLEAR_M:
                free.append(int(index))
        return int(self._rng.choice(free)) if free else None

    def _free_place(self, state: np.ndarray, block: int) -> np.ndarray | None:
        """Return a place (3,) where an episode may have it, None if none is free."""
        if self._task.fixtures and self._task.qpos(state)[5] > _SHUT_M:
            return None  # What is drawn below is where an open drawer may be.
        others = np.delete(self._task.block_positions(state[None])[0], block, axis=0)
        gripper = self._task.qpos(state)[None, :3]
        taken = np.vstack([others, self._goal, gripper])[:, :2]
        for _ in range(_DRAWS):
            drawn, _ = self._task.reset(self._rng)
            place = self._task.block_positions(drawn[None])[0, block]
            if (np.linalg.norm(taken - place[:2], axis=1) >= _APART_M).all():
                return place
        return None
