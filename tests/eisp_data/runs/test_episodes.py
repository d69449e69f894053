"""Which episodes are held out."""

import numpy as np
import pytest

from eisp_data.runs.episodes import split


@pytest.mark.parametrize("share", [0.05, 0.1, 0.25, 0.5])
@pytest.mark.parametrize("seed", range(4))
def test_an_episode_stays_where_it_is_when_the_dataset_grows(share, seed):
    few, many = (set(split(count, share, seed)[0].tolist()) for count in (300, 417))
    assert few == {episode for episode in many if episode < 300}


@pytest.mark.parametrize("episodes", [2, 7, 60, 3000])
def test_every_episode_is_in_one_part_and_the_share_is_held_out(episodes):
    for seed in range(20):
        held, rest = split(episodes, 0.1, seed)
        assert len(held) and sorted([*held, *rest]) == list(range(episodes))
        assert abs(len(held) - 0.1 * episodes) <= 2
    assert not np.array_equal(split(3000, 0.1, 0)[0], split(3000, 0.1, 1)[0])


def test_a_single_episode_is_held_out():
    held, rest = split(1, 0.1, 0)
    assert held.tolist() == [0] and not len(rest)
