"""Stack: a tower in a fixed order."""

from __future__ import annotations

import numpy as np
import pytest

from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import is_success
from eisp_data.tasks.registry import get_task


def many_resets(count: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """Return blocks (N, 3, 3) and goals (N, 3, 3)."""
    task = get_task("stack")
    starts = [task.reset(np.random.default_rng(seed)) for seed in range(count)]
    states, goals = (np.array(part) for part in zip(*starts, strict=True))
    return task.block_positions(states), goals.reshape(-1, 3, 3)


def test_the_goal_is_a_tower_and_block_i_belongs_on_level_i():
    _, goals = many_resets()
    np.testing.assert_array_equal(goals[:, :, :2], np.repeat(goals[:, :1, :2], 3, axis=1))
    np.testing.assert_allclose(goals[:, :, 2], np.tile([0.025, 0.075, 0.125], (100, 1)), atol=1e-6)


def test_blocks_start_on_the_table_with_room_for_a_finger_between_them_and_the_tower():
    blocks, goals = many_resets()
    np.testing.assert_allclose(blocks[..., 2], 0.025)
    places = np.concatenate([blocks[..., :2], goals[:, :1, :2]], axis=1)
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    assert apart[:, ~np.eye(4, dtype=bool)].min() >= 0.0999


def test_a_tower_one_level_too_low_or_in_another_order_is_no_success():
    _, goals = many_resets(1)
    shuffled, missing = goals[0][[1, 0, 2]], goals[0].copy()
    missing[2] = [0.25, -0.15, 0.025]
    assert is_success(goals[0].ravel(), goals[0].ravel())
    assert not is_success(shuffled.ravel(), goals[0].ravel())
    assert not is_success(missing.ravel(), goals[0].ravel())


def test_a_held_block_is_not_settled_and_a_released_tower_is():
    task = get_task("stack")
    tower = np.array([[0.3, 0.0, 0.025 + 0.05 * level] for level in range(3)])
    away, around = np.array([0.36, 0.15, 0.25]), tower[2]
    states = np.array([task.state_of(away, tower), task.state_of(around, tower)])
    task.qpos(states)[1, 3:5] = 0.025  # the fingers touch the top block on both sides
    np.testing.assert_array_equal(task.settled(states), [True, False])


@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_a_block_that_is_gripped_over_its_corners_is_held_too(degrees):
    task = get_task("stack")
    under = np.array([[0.30, 0.0, 0.025], [0.40, 0.10, 0.025], [0.22, 0.12, 0.025]])
    state = task.state_of(np.array([0.30, 0.0, 0.03]), under)
    half = np.radians(degrees) / 2
    task.qpos(state)[8:12] = [np.cos(half), 0, 0, np.sin(half)]
    worlds = Worlds(task, 1, threads=1)
    worlds.restore(state[None], np.zeros((1, 9), np.float32))
    for action in [[0, 0, 0, -1]] * 10 + [[0, 0, 0.3, -1]] * 10 + [[0, 0, 0, -1]] * 10:
        worlds.step(np.array([action]))
    assert task.block_positions(worlds.state)[0, 0, 2] > 0.1
    assert not task.hands_off(worlds.state)[0]
    for _ in range(20):
        worlds.step(np.array([[0.0, 0.0, 0.0, 1.0]]))
    assert task.hands_off(worlds.state)[0]
