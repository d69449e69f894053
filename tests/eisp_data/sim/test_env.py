"""The Gymnasium front: every task passes Gymnasium's checks and is what the worlds are."""

from __future__ import annotations

import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import eisp_data  # noqa: F401  registers the ids
from eisp_data.errors import ConfigError
from eisp_data.sim.env import TaskEnv
from eisp_data.sim.registration import ENV_IDS
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS

ONLY_UNBOUNDED = "A Box observation space (min|max)imum value is"
"""Positions and velocities have no bounds, as in Gymnasium-Robotics; all else would be news."""


@pytest.mark.parametrize("name", TASKS)
def test_every_task_passes_gymnasiums_checks(name):
    env = gymnasium.make(ENV_IDS[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", f".*{ONLY_UNBOUNDED}")
        check_env(env.unwrapped, skip_render_check=True)
    assert env.spec is not None and env.spec.max_episode_steps == TASKS[name].paper.episode_steps


def test_the_ids_name_the_tasks_of_the_registry():
    assert set(ENV_IDS) == set(TASKS)
    for name, task in TASKS.items():
        assert ENV_IDS[name] == f"eisp/{type(task).__name__}-v0"


@pytest.mark.parametrize("name", TASKS)
def test_the_env_is_one_of_the_worlds(name):
    env, worlds = TaskEnv(name), Worlds(TASKS[name], 3, threads=1)
    observation, info = env.reset(seed=11)
    worlds.reset([10, 11, 12])
    rng = np.random.default_rng(0)
    for _ in range(20):
        np.testing.assert_array_equal(observation["observation"], worlds.observation[1])
        np.testing.assert_array_equal(observation["achieved_goal"], worlds.achieved_goal[1])
        np.testing.assert_array_equal(observation["desired_goal"], worlds.desired_goal[1])
        assert info["is_success"] == worlds.success[1]
        action = rng.uniform(-1, 1, (3, 4)).astype(np.float32)
        worlds.step(action)
        observation, reward, terminated, truncated, info = env.step(action[1])
        assert reward == (0.0 if info["is_success"] else -1.0)
        assert not terminated and not truncated


def test_a_seed_fixes_this_episode_and_the_ones_after_it():
    def goals(seed: int) -> np.ndarray:
        env = TaskEnv("stack")
        first = env.reset(seed=seed)[0]["desired_goal"]
        return np.array([first, env.reset()[0]["desired_goal"], env.reset()[0]["desired_goal"]])

    np.testing.assert_array_equal(goals(3), goals(3))
    assert not np.array_equal(goals(3), goals(4))
    assert len(np.unique(goals(3), axis=0)) == 3


def test_success_does_not_end_an_episode_and_the_step_limit_cuts_it():
    env = gymnasium.make("eisp/Stack-v0", max_episode_steps=7)
    env.reset(seed=0)
    inner = env.unwrapped
    assert isinstance(inner, TaskEnv)
    solved = inner.task.state_of(
        np.array([0.2, -0.15, 0.25]), inner.worlds.desired_goal[0].reshape(3, 3)
    )
    inner.worlds.restore(solved[None], inner.worlds.desired_goal)
    rest = np.array([0.0, 0.0, 0.0, 1.0], np.float32)
    steps = [env.step(rest) for _ in range(7)]
    assert [reward for _, reward, *_ in steps] == [0.0] * len(steps)
    assert not any(terminated for _, _, terminated, *_ in steps)
    assert [truncated for *_, truncated, _ in steps] == [False] * (len(steps) - 1) + [True]


def test_rewards_and_ends_are_computed_for_many_goals_at_once():
    env = TaskEnv("stack")
    achieved, desired = np.zeros((5, 9), np.float32), np.zeros((5, 9), np.float32)
    achieved[2:, 0] = 0.2
    np.testing.assert_array_equal(env.compute_reward(achieved, desired, {}), [0, 0, -1, -1, -1])
    for ends in (env.compute_terminated, env.compute_truncated):
        np.testing.assert_array_equal(ends(achieved, desired, {}), [False] * 5)


def test_an_env_goes_to_another_process_and_back():
    env = TaskEnv("stack", render_mode="rgb_array", width=64, height=48)
    env.reset(seed=3)
    env.render()
    other = pickle.loads(pickle.dumps(env))
    action = np.array([0.5, 0.2, -0.1, 1.0], np.float32)
    np.testing.assert_array_equal(
        env.step(action)[0]["observation"], other.step(action)[0]["observation"]
    )
    env.close()


def test_envs_run_in_processes_of_gymnasiums_own():
    envs = gymnasium.make_vec("eisp/Stack-v0", num_envs=2, vectorization_mode="async")
    try:
        observation, _ = envs.reset(seed=5)
        worlds = Worlds(TASKS["stack"], 2, threads=1)
        worlds.reset([5, 6])
        np.testing.assert_array_equal(observation["observation"], worlds.observation)
    finally:
        envs.close()


def test_an_unknown_task_render_mode_or_camera_is_named_with_the_choices():
    with pytest.raises(ConfigError, match=r"unknown task 'stak'.*stack"):
        TaskEnv("stak")
    with pytest.raises(ConfigError, match=r"unknown render_mode 'human'.*rgb_array"):
        TaskEnv("stack", render_mode="human")
    with pytest.raises(ConfigError, match=r"unknown camera 'side'.*front, top, shoulder"):
        TaskEnv("stack", camera="side")
