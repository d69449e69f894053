"""The scripts of the drawer: they solve their tasks; their demonstrators mostly do not."""

from __future__ import annotations

import numpy as np
import pytest

from eisp_data.collect import collect
from eisp_data.episode import Episode
from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
from eisp_data.policies.script import Noise
from eisp_data.sim.drawer import HANDLE_CLOSED_M, TRAVEL_M
from eisp_data.tasks.registry import get_task

NAMES = ("open_drawer", "store")
LEAST_RETURN = {"open_drawer": -40.0, "store": -60.0}


def play(name: str, noise: Noise, count: int) -> list[Episode]:
    return list(collect(get_task(name), SCRIPTS[name], noise, range(count), threads=1))


@pytest.fixture(scope="module")
def oracle() -> dict[str, list[Episode]]:
    return {name: play(name, Noise(), 40) for name in NAMES}


@pytest.fixture(scope="module")
def demonstrations() -> dict[str, list[Episode]]:
    return {name: play(name, DEMONSTRATOR[name], 60) for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_the_oracle_solves_its_task_and_leaves_all_at_rest(oracle, name):
    task = get_task(name)
    solved = [episode.success[-1] for episode in oracle[name]]
    settled = [task.settled(episode.sim_state[-1:])[0] for episode in oracle[name]]
    assert sum(solved) >= 38 and sum(settled) >= 38
    assert np.mean([episode.reward.sum() for episode in oracle[name]]) > LEAST_RETURN[name]


def test_the_oracle_clears_the_way_before_it_touches_the_drawer(oracle):
    for episode in oracle["open_drawer"]:
        opening = HANDLE_CLOSED_M[0] - episode.achieved_goal[:, 3]
        first = int(np.argmax(opening > 0.01))
        assert abs(episode.achieved_goal[first, 1]) > 0.10, "the block is out of the way"


def test_the_oracle_stores_in_an_open_drawer(oracle):
    for episode in oracle["store"]:
        opening = HANDLE_CLOSED_M[0] - episode.achieved_goal[:, 3]
        assert opening.max() > TRAVEL_M - 0.01 and opening[0] < 1e-6 and opening[-1] < 0.02


@pytest.mark.parametrize("name", NAMES)
def test_at_most_a_tenth_of_the_demonstrations_succeed_at_any_step(demonstrations, name):
    # 60 episodes at 10% give ten or fewer with a probability of 97%.
    assert sum(bool(episode.success.any()) for episode in demonstrations[name]) <= 10


@pytest.mark.parametrize("name", NAMES)
def test_demonstrations_move_block_and_drawer_and_end_at_rest(demonstrations, name):
    task = get_task(name)
    episodes = demonstrations[name]
    ways = np.array([np.ptp(e.achieved_goal, axis=0)[[0, 1, 3]] for e in episodes])
    moved_block = ways[:, :2].max(axis=1) > 0.05
    assert moved_block.mean() > 0.8 and (ways[:, 2] > 0.04).mean() > 0.8
    assert np.mean([task.settled(e.sim_state[-1:])[0] for e in episodes]) > 0.8
    # What has fallen off the table ends its episode.
    lasting = [e for e in episodes if e.achieved_goal[-1, 2] > 0.0]
    assert len(lasting) > 0.9 * len(episodes)
    assert all(100 <= len(e) <= 400 for e in lasting)
