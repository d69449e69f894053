"""Push4: four places, closed fingers, and blocks in each other's way at times."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from eisp_data.policies.push_plan import BESIDE_M
from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.push4 import SEPARATION_M
from eisp_data.tasks.registry import get_task
from eisp_data.tasks.ways import on_the_way

ORDERS = list(permutations(range(4)))


@pytest.fixture(scope="module")
def resets() -> tuple[np.ndarray, np.ndarray]:
    """Starts and goals, (200, 4, 2) each."""
    task = get_task("push4")
    drawn = [task.reset(np.random.default_rng(seed)) for seed in range(200)]
    states, goals = (np.array(part) for part in zip(*drawn, strict=True))
    assert (goals.reshape(-1, 4, 3)[..., 2] == np.float32(0.025)).all()
    return task.block_positions(states)[..., :2], goals.reshape(-1, 4, 3)[..., :2]


def working_orders(starts: np.ndarray, goals: np.ndarray) -> list[tuple[int, ...]]:
    """Return the orders in which straight pushes meet no other block, by brute force."""
    # Half a millimetre less than the task keeps: its goals are rounded to float32.
    clear = 0.0535
    at_start = on_the_way(starts[:, None], goals[:, None], starts, clear)
    at_goal = on_the_way(starts[:, None], goals[:, None], goals, clear)
    return [
        order
        for order in ORDERS
        if not any(
            at_goal[block, list(order[:turn])].any()
            or at_start[block, list(order[turn + 1 :])].any()
            for turn, block in enumerate(order)
        )
    ]


def test_starts_keep_apart_and_so_do_goals(resets):
    for places in resets:
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        assert apart[:, ~np.eye(4, dtype=bool)].min() >= SEPARATION_M - 1e-6


def test_the_pusher_gets_behind_every_block_and_goal_on_every_side(resets):
    for places in resets:
        assert (places - BESIDE_M >= np.array(WORKSPACE_LOW_M[:2])).all()
        assert (places + BESIDE_M <= np.array(WORKSPACE_HIGH_M[:2])).all()


def test_some_order_of_straight_pushes_always_works_and_often_not_any_order(resets):
    orders = [working_orders(*reset) for reset in zip(*resets, strict=True)]
    assert all(orders)
    share = np.mean([len(working) < len(ORDERS) for working in orders])
    assert 0.25 < share < 0.6


def test_the_fourth_action_does_nothing():
    task = get_task("push4")
    worlds = Worlds(task, 2, threads=1)
    worlds.reset([0, 0])
    for step in range(10):
        worlds.step(np.array([[0.2, 0.0, -0.1, 1.0], [0.2, 0.0, -0.1, -1.0]]))
        np.testing.assert_array_equal(worlds.state[0], worlds.state[1], err_msg=f"step {step}")
    assert np.abs(task.qpos(worlds.state)[:, 3:5]).max() < 1e-3, "the fingers are closed"


def test_closed_fingers_push_a_block_without_kicking_it_away():
    task = get_task("push4")
    blocks = np.array(
        [[0.30, -0.10, 0.025], [0.23, 0.0, 0.025], [0.23, 0.1, 0.025], [0.4, 0.1, 0.025]]
    )
    worlds = Worlds(task, 1, threads=1)
    start = task.state_of(np.array([0.30, -0.15, 0.02]), blocks)
    worlds.restore(start[None], np.zeros((1, 12), np.float32))
    for _ in range(12):
        worlds.step(np.array([[0.0, 0.3, 0.0, 0.0]]))
        gap = task.block_positions(worlds.state)[0, 0, 1] - task.qpos(worlds.state)[0, 1]
        assert gap < 0.052
    assert task.block_positions(worlds.state)[0, 0, 1] > -0.05, "it was pushed"


def test_on_the_way_tells_a_square_that_a_segment_enters_from_one_that_it_passes():
    start, end = np.array([0.0, 0.0]), np.array([1.0, 0.5])
    others = np.array([[0.5, 0.25], [0.5, 0.40], [-0.2, 0.0], [1.05, 0.5], [0.5, 0.375]])
    expected = [True, False, False, True, True]
    np.testing.assert_array_equal(on_the_way(start, end, others, 0.1), expected)
