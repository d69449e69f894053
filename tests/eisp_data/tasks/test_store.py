"""Store: a block that rides in the tray, and a goal that is the closed drawer with it inside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from eisp_data.policies.drawer import slide_drawer
from eisp_data.policies.script import Aim, Keyframe, Noise, ScriptedPolicy, View
from eisp_data.sim.drawer import HANDLE_CLOSED_M, PATH_HALF_WIDTH_M, TRAVEL_M, TRAY_CENTRE_M
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import get_task

REST = np.array([[0.0, 0.0, 0.0, 1.0]])
ABOVE = np.array([0.30, 0.0, 0.20])


@pytest.fixture(scope="module")
def task():
    return get_task("store")


def in_tray(task, opening: float, goal: np.ndarray | None = None) -> Worlds:
    """Return one world with the block in the middle of the tray, or where (6,) a goal wants it."""
    worlds = Worlds(task, 1, threads=1)
    block = np.array(TRAY_CENTRE_M) if goal is None else goal[:3].astype(float)
    block = block - [opening, 0.0, 0.0]
    state = task.state_of(ABOVE, block[None], np.array([opening]))
    desired = np.append(TRAY_CENTRE_M, HANDLE_CLOSED_M) if goal is None else goal
    worlds.restore(state[None], desired[None].astype(np.float32))
    return worlds


def close_then_open(view: View, aim: Aim) -> Iterator[Keyframe]:
    yield from slide_drawer(view, aim, 0.0)
    yield from slide_drawer(view, aim, TRAVEL_M)


def test_goals_lie_inside_the_closed_drawer_and_starts_outside(task):
    for seed in range(100):
        state, goal = task.reset(np.random.default_rng(seed))
        np.testing.assert_allclose(goal[3:], HANDLE_CLOSED_M, atol=1e-6)
        assert np.abs(goal[:3] - TRAY_CENTRE_M).max() < 0.02
        assert task.openings(state[None])[0] == 0.0
        assert task.block_positions(state[None])[0, 0, 0] < HANDLE_CLOSED_M[0] + 0.02


def test_a_start_in_the_drawers_way_is_the_exception(task):
    starts = np.array(
        [
            task.block_positions(task.reset(np.random.default_rng(seed))[0][None])[0, 0]
            for seed in range(200)
        ]
    )
    assert 0.05 < np.mean(np.abs(starts[:, 1]) < PATH_HALF_WIDTH_M) < 0.3


def test_every_goal_is_a_state_in_which_all_rests(task):
    for seed in range(5):
        worlds = in_tray(task, 0.0, task.reset(np.random.default_rng(seed))[1])
        start = worlds.achieved_goal
        for _ in range(100):
            worlds.step(REST)
        np.testing.assert_allclose(worlds.achieved_goal, start, atol=1e-3)
        assert worlds.success.all() and task.settled(worlds.state).all()


def test_the_block_rides_in_the_tray(task):
    worlds = in_tray(task, TRAVEL_M)
    policy = ScriptedPolicy(task, close_then_open, Noise(), 1)
    policy.begin(0, worlds.state, worlds.desired_goal[0], 0)
    least = TRAVEL_M
    solved = False
    for _ in range(80):
        worlds.step(policy.act(worlds.state))
        opening = task.openings(worlds.state)[0]
        least, solved = min(least, opening), solved or bool(worlds.success[0])
        block = task.block_positions(worlds.state)[0, 0]
        offset = block - np.array(TRAY_CENTRE_M) + [opening, 0.0, 0.0]
        assert np.abs(offset[:2]).max() < 0.045, "it stays within the tray's walls"
        assert abs(offset[2]) < 0.012, "it neither sinks in nor jumps out"
    assert least < 0.005 and solved
    assert task.openings(worlds.state)[0] > TRAVEL_M - 0.005


def test_a_block_in_the_tray_is_not_pressed_through_its_floor_or_walls(task):
    for direction in ([0, 0, -1, -1], [0, 1, -0.3, -1], [0, -1, -0.3, -1]):
        worlds = in_tray(task, TRAVEL_M)
        start = TRAY_CENTRE_M[0] - TRAVEL_M
        aside = 0.0 if direction[1] == 0 else -0.045 * direction[1]
        gripper = np.array([start, aside, 0.08 if direction[1] == 0 else 0.035])
        task.qpos(worlds.state)[0, :5] = [*gripper, 0.0, 0.0]
        for _ in range(100):
            worlds.step(np.array([direction], float))
            block = task.block_positions(worlds.state)[0, 0]
            assert block[2] > TRAY_CENTRE_M[2] - 0.005
            assert abs(block[1]) < 0.070 - 0.025 + 0.006 or block[2] > 0.06
