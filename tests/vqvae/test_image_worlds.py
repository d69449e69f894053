"""Worlds seen in images are the state task's worlds; only what a policy sees differs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eisp_data.errors import ConfigError
from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.sim.worlds import Worlds
from eisp_data.storage.cache import load_arrays, load_images
from eisp_data.tasks.base import is_success
from eisp_data.tasks.images import IMAGE_TASKS, goal_state, image_task, state_task
from vqvae.latents import encode, observe, see
from vqvae.saved import load
from vqvae.worlds import ImageWorlds


@pytest.fixture
def worlds(vqvae_run) -> ImageWorlds:
    return ImageWorlds("open_drawer_image", *load(vqvae_run), count=2, threads=1)


def test_states_and_success_are_those_of_the_state_task(worlds):
    plain = Worlds(worlds.task, 2, threads=1)
    for each in (worlds, plain):
        each.reset([3, 4])
    rng = np.random.default_rng(0)
    for _ in range(10):
        action = rng.uniform(-1, 1, (2, 4))
        worlds.step(action)
        plain.step(action)
    assert np.array_equal(worlds.state, plain.state)
    assert np.array_equal(worlds.place, plain.desired_goal)
    assert np.array_equal(worlds.success, plain.success)
    assert np.array_equal(worlds.observation[:, :10], plain.observation[:, :10])
    assert (worlds.name, worlds.episode_steps) == ("open_drawer_image", plain.episode_steps)


def test_a_solved_world_is_a_success_though_no_policy_is_told_the_places(worlds):
    task = worlds.task
    worlds.reset([7, 8])
    script = ScriptedPolicy(task, SCRIPTS[task.name], Noise(), 2)
    for world in range(2):
        script.begin(world, worlds.state, worlds.place[world], world)
    for _ in range(worlds.episode_steps):
        worlds.step(script.act(worlds.state))
    assert worlds.success.all() and worlds.settled.all() and not worlds.hopeless.any()


def test_what_is_seen_is_the_latent_of_the_image_and_new_after_a_step(worlds, vqvae_run):
    model, _ = load(vqvae_run)
    worlds.reset([3, 4])
    first = worlds.achieved_goal
    assert np.array_equal(first, see(model, encode(model, worlds.images())))
    seen = observe(worlds.observation[:, :10], first, model.places)
    assert np.array_equal(worlds.observation, seen)
    for _ in range(15):
        worlds.step(np.tile([-1.0, 1.0, -1.0, 0.0], (2, 1)))
    assert not np.array_equal(first, worlds.achieved_goal)


def test_drawn_images_are_those_of_the_dataset_but_for_the_video(images, worlds):
    arrays, stored = load_arrays(images), load_images(images, "shoulder")
    goals = np.zeros((2, 6), np.float32)
    worlds.restore(arrays.sim_state[[5, 60]], goals)
    apart = np.abs(worlds.images().astype(int) - stored[[5, 60]])
    assert apart.mean() < 2.5


def test_the_goal_is_a_picture_of_a_success(worlds):
    worlds.reset([3, 4])
    task = IMAGE_TASKS["open_drawer_image"]
    goals = np.stack([goal_state(task, place) for place in worlds.place])
    assert is_success(task.achieved_goal(goals), worlds.place).all()
    assert not np.array_equal(worlds.desired_goal, worlds.achieved_goal)
    worlds.restore(goals, worlds.place.copy())
    assert np.array_equal(worlds.desired_goal, worlds.achieved_goal)
    assert worlds.success.all()


def test_a_snapshot_brings_all_back(worlds):
    worlds.reset([3, 4])
    worlds.step(np.ones((2, 4)))
    kept = worlds.snapshot()
    seen, goal = worlds.observation, worlds.desired_goal.copy()
    worlds.reset([5, 6])
    worlds.restore_snapshot(kept)
    assert np.array_equal(worlds.observation, seen)
    assert np.array_equal(worlds.desired_goal, goal)


def test_a_vqvae_of_another_task_is_refused(vqvae_run):
    model, vision = load(vqvae_run)
    with pytest.raises(ConfigError, match="store_image: the VQ-VAE was trained on 'open_drawer'"):
        ImageWorlds("store_image", model, vision, 1)
    with pytest.raises(ConfigError):
        ImageWorlds("open_drawer_image", model, replace(vision, camera="nowhere"), 1)


def test_names_of_image_tasks_lead_to_their_worlds():
    assert set(IMAGE_TASKS) == {"open_drawer_image", "store_image"}
    assert state_task(image_task("store")) == "store" and state_task("stack") == "stack"
    with pytest.raises(ConfigError, match="'stack' has no image variant"):
        image_task("stack")
