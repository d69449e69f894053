"""What every task of the registry keeps to."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from eisp_data.errors import ConfigError
from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import OBJECT_DIM, Task, compute_reward
from eisp_data.tasks.registry import TASKS, get_task

TABLE_I = {
    "stack": (55, 9, 4, 300),
    "push4": (70, 12, 4, 400),
    "open_drawer": (42, 6, 4, 300),
    "store": (42, 6, 4, 1000),
}
"""S, G, A and L of the paper's Table I."""


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest) -> Task:
    return get_task(request.param)


def after_random_steps(task: Task, count: int = 6, steps: int = 40) -> Worlds:
    worlds = Worlds(task, count, threads=1)
    worlds.reset(range(count))
    rng = np.random.default_rng(0)
    for _ in range(steps):
        worlds.step(rng.uniform(-1, 1, (count, 4)))
    return worlds


def test_the_registry_holds_the_papers_four_tasks_each_with_a_script_and_a_demonstrator():
    assert set(TASKS) == set(TABLE_I) == set(SCRIPTS) == set(DEMONSTRATOR)


def test_dimensions_are_those_of_table_i(task):
    paper = task.paper
    dims = paper.observation_dim, paper.goal_dim, paper.action_dim, paper.episode_steps
    assert dims == TABLE_I[task.name]
    worlds = Worlds(task, 2, threads=1)
    worlds.reset([0, 1])
    assert worlds.observation.shape == (2, paper.observation_dim)
    assert worlds.achieved_goal.shape == worlds.desired_goal.shape == (2, paper.goal_dim)


def test_observations_and_goals_stay_finite_float32_under_random_actions(task):
    worlds = after_random_steps(task)
    for array in (worlds.observation, worlds.achieved_goal, worlds.desired_goal):
        assert array.dtype == np.float32
        assert np.isfinite(array).all()


def test_a_seed_fixes_the_start_the_goal_and_all_that_follows(task):
    first, second = after_random_steps(task), after_random_steps(task)
    np.testing.assert_array_equal(first.state, second.state)
    np.testing.assert_array_equal(first.desired_goal, second.desired_goal)
    assert len(np.unique(first.desired_goal, axis=0)) == first.count, "seeds differ"


def test_no_episode_starts_solved_or_in_motion(task):
    worlds = Worlds(task, 60, threads=1)
    worlds.reset(range(60))
    assert not worlds.success.any()
    start = task.achieved_goal(worlds.state)
    rest = np.tile([0.0, 0.0, 0.0, 1.0], (60, 1))
    for _ in range(10):
        worlds.step(rest)
    np.testing.assert_allclose(worlds.achieved_goal, start, atol=1e-3)


def test_objects_lie_in_observation_and_goal_where_their_slots_say(task):
    worlds = after_random_steps(task)
    goal_columns: list[int] = []
    for slot in task.objects:
        features = worlds.observation[:, slot.observation]
        assert features.shape[1] == OBJECT_DIM
        achieved = worlds.achieved_goal[:, slot.goal]
        np.testing.assert_allclose(features[:, :3], achieved, atol=1e-6)
        gripper = worlds.observation[:, :3]
        np.testing.assert_allclose(features[:, 3:6], achieved - gripper, atol=1e-6)
        goal_columns += range(slot.goal.start, slot.goal.stop)
    assert goal_columns == list(range(task.paper.goal_dim))


def test_observed_velocities_are_the_rates_of_the_observed_positions(task):
    worlds = after_random_steps(task, steps=12)
    tick_s = 1e-4
    later = worlds.state.copy()
    for qpos, qvel in zip(task.qpos(later), task.qvel(later), strict=True):
        mujoco.mj_integratePos(task.model, qpos, qvel, tick_s)
    now, then = task.observe(worlds.state).astype(float), task.observe(later).astype(float)
    rate = (then - now) / tick_s
    for slot in task.objects:
        first = slot.observation.start
        position, velocity = rate[:, first : first + 3], now[:, first + 9 : first + 12]
        np.testing.assert_allclose(position, velocity, atol=0.01)
    np.testing.assert_allclose(rate[:, :5], now[:, 5:10], atol=0.01)


def test_the_reward_is_eq_1_on_the_norm_of_the_whole_goal(task):
    dim = task.paper.goal_dim
    desired = np.zeros((3, 4, dim), np.float32)
    achieved = desired.copy()
    achieved[0] += 0.0499 / np.sqrt(dim)
    achieved[1] += 0.0501 / np.sqrt(dim)
    achieved[2, :, 0] = 0.049
    achieved[2, :, dim - 1] = 0.02  # each within 5 cm, the norm is not
    reward = compute_reward(achieved, desired)
    assert reward.shape == (3, 4) and reward.dtype == np.float32
    np.testing.assert_array_equal(reward[:, 0], [0.0, -1.0, -1.0])
    assert compute_reward(achieved[0, 0], desired[0, 0]) == 0.0


def test_the_gripper_stays_in_the_workspace_whatever_the_actions(task):
    worlds = Worlds(task, 8, threads=1)
    worlds.reset(range(8))
    corners = np.array([[x, y, z, 1.0] for x in (-9, 9) for y in (-9, 9) for z in (-9, 9)])
    for _ in range(40):
        worlds.step(corners)
        gripper = task.qpos(worlds.state)[:, :3]
        assert (gripper > np.array(WORKSPACE_LOW_M) - 0.012).all()
        assert (gripper < np.array(WORKSPACE_HIGH_M) + 0.012).all()


def test_an_unknown_task_is_named_with_the_choices():
    with pytest.raises(ConfigError, match=r"unknown task 'stacks'; choose one of stack, push4"):
        get_task("stacks")
