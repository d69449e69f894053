"""Frames are real: what stands on the table, and where goals and subgoals are, can be seen."""

from __future__ import annotations

import numpy as np
import pytest

from eisp_data.errors import ConfigError
from eisp_data.sim.env import TaskEnv
from eisp_data.sim.render import Renderer
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS, get_task


@pytest.fixture(scope="module", autouse=True)
def gl() -> None:
    try:
        Renderer(get_task("stack"), width=16, height=16).close()
    except ConfigError as error:
        pytest.skip(str(error))


def start_of(name: str) -> Worlds:
    worlds = Worlds(get_task(name), 1, threads=1)
    worlds.reset([0])
    return worlds


def changed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return which pixels of two frames differ clearly, (H, W) bool."""
    return np.abs(first.astype(int) - second).max(axis=-1) > 24


@pytest.mark.parametrize("camera", ["front", "top"])
@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_drawn_with_its_goals_in_the_picture(name, camera):
    worlds = start_of(name)
    with Renderer(worlds.task, camera, width=320, height=240) as renderer:
        plain = renderer.render(worlds.state[0])
        goals = renderer.render(worlds.state[0], worlds.desired_goal[0])
    assert plain.shape == (240, 320, 3) and plain.dtype == np.uint8
    assert plain.std() > 15, "not one flat colour"
    assert changed(plain, goals).sum() > 20


def test_a_moved_block_changes_the_picture_where_it_was_and_where_it_is_only():
    worlds = start_of("stack")
    moved = worlds.state.copy()
    worlds.task.qpos(moved)[0, 5:7] += [0.0, 0.15]
    with Renderer(worlds.task, width=320, height=240) as renderer:
        before, after = renderer.render(worlds.state[0]), renderer.render(moved[0])
        again = renderer.render(worlds.state[0])
    assert 100 < changed(before, after).sum() < 0.1 * 320 * 240
    np.testing.assert_array_equal(before, again)


def test_a_subgoal_is_a_translucent_cube_in_the_colour_of_its_block():
    worlds = start_of("stack")
    subgoal = worlds.achieved_goal[0].copy()
    subgoal[2] += 0.12  # the first block is red
    with Renderer(worlds.task, "top", width=320, height=240) as renderer:
        plain = renderer.render(worlds.state[0])
        marked = renderer.render(worlds.state[0], subgoal=subgoal)
    difference = changed(plain, marked)
    cube = marked[difference].mean(axis=0)
    assert difference.sum() > 100
    assert cube[0] > cube[1] + 20 and cube[0] > cube[2] + 20


def test_the_env_renders_and_renders_nothing_without_a_mode():
    env = TaskEnv("stack", render_mode="rgb_array", camera="top", width=64, height=48)
    env.reset(seed=0)
    frame = env.render()
    assert frame is not None and frame.shape == (48, 64, 3)
    env.close()
    silent = TaskEnv("stack")
    silent.reset(seed=0)
    assert silent.render() is None


def test_an_unknown_camera_is_named_with_the_choices():
    with pytest.raises(ConfigError, match="unknown camera 'side'; choose one of front, top"):
        Renderer(get_task("stack"), "side")
