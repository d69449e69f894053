"""The scripts solve their tasks; their demonstrators mostly do not."""

from __future__ import annotations

import numpy as np
import pytest

from eisp_data.collect import collect
from eisp_data.episode import Episode
from eisp_data.policies.push_plan import choose_push
from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import get_task

SEEDS = range(40)


def play(name: str, steps: int) -> tuple[Worlds, np.ndarray, ScriptedPolicy]:
    """Return the worlds after so many steps of the oracle, its returns (N,) and its policy."""
    task = get_task(name)
    worlds = Worlds(task, len(SEEDS), threads=2)
    worlds.reset(SEEDS)
    policy = ScriptedPolicy(task, SCRIPTS[name], Noise(), len(SEEDS))
    for world, seed in enumerate(SEEDS):
        policy.begin(world, worlds.state, worlds.desired_goal[world], seed)
    returns = np.zeros(len(SEEDS))
    for _ in range(steps):
        worlds.step(policy.act(worlds.state))
        returns += worlds.success - 1.0
    return worlds, returns, policy


@pytest.mark.parametrize(("name", "least_return"), [("stack", -70.0), ("push4", -65.0)])
def test_the_oracle_solves_its_task_leaves_all_at_rest_and_is_quick(name, least_return):
    worlds, returns, policy = play(name, steps=160)
    assert worlds.success.mean() >= 0.97
    assert worlds.task.settled(worlds.state).mean() >= 0.97
    assert policy.finished.mean() >= 0.97
    assert np.median(returns) >= least_return


@pytest.fixture(scope="module", params=["stack", "push4"])
def demonstrations(request: pytest.FixtureRequest) -> list[Episode]:
    name = request.param
    return list(collect(get_task(name), SCRIPTS[name], DEMONSTRATOR[name], SEEDS[:20], threads=2))


def test_at_most_a_tenth_of_the_demonstrations_succeed(demonstrations):
    # 20 episodes at 10% give four or fewer with a probability of 96%.
    assert sum(bool(episode.success[-1]) for episode in demonstrations) <= 4


def test_demonstrations_move_blocks_and_do_not_throw_them_about(demonstrations):
    ways, slow = [], []
    for episode in demonstrations:
        goals = episode.achieved_goal.reshape(len(episode) + 1, -1, 3)
        ways.append(np.linalg.norm(goals[-1] - goals[0], axis=-1).max())
        last = np.linalg.norm(goals[-1] - goals[-2], axis=-1).max()
        slow.append(last < 0.002)
    assert np.mean(np.array(ways) > 0.03) > 0.9
    assert np.mean(slow) > 0.85


def test_the_next_push_is_the_lowest_number_that_obstructs_nobody():
    blocks = np.array([[0.25, -0.1], [0.25, 0.1], [0.37, -0.1], [0.37, 0.1]])
    targets = blocks.copy()
    targets[:2] = [[0.31, -0.1], [0.31, 0.1]]
    push = choose_push(blocks, targets, np.array([True, True, False, False]))
    assert push is not None and push.block == 0
    np.testing.assert_array_equal(push.normal, [1.0, 0.0])
    assert choose_push(blocks, targets, np.zeros(4, bool)) is None


def test_a_block_on_anothers_goal_is_pushed_first():
    blocks = np.array([[0.25, -0.1], [0.25, 0.0], [0.37, -0.1], [0.37, 0.1]])
    targets = blocks.copy()
    targets[0], targets[1] = blocks[1], [0.25, 0.12]
    push = choose_push(blocks, targets, np.array([True, True, False, False]))
    assert push is not None and push.block == 1


def test_two_blocks_that_swap_places_begin_with_a_step_aside():
    blocks = np.array([[0.25, -0.06], [0.25, 0.06], [0.38, -0.14], [0.38, 0.14]])
    targets = blocks[[1, 0, 2, 3]]
    push = choose_push(blocks, targets, np.array([True, True, False, False]))
    assert push is not None
    assert np.linalg.norm(push.target - targets[push.block]) > 0.02
