"""Seeds: what is evaluated on, learned from, chosen by and learned in are all different."""

import pytest

from eisp_data.errors import ConfigError
from eisp_data.seeds import (
    LAST_SEED,
    SEEDS_APART,
    SELECTION_SEED,
    check_unlearned,
    episode_seeds,
    first_online_seed,
)


def test_evaluations_datasets_selection_and_learning_online_share_no_episode():
    first, last = episode_seeds(0, 0, SEEDS_APART), episode_seeds(LAST_SEED, 0, SEEDS_APART)
    assert first.start == SEEDS_APART, "evaluations have those before"
    assert last.stop <= SELECTION_SEED
    assert first_online_seed(0) >= SELECTION_SEED + SEEDS_APART


def test_datasets_and_runs_of_different_seeds_share_no_episode():
    assert episode_seeds(0, 0, SEEDS_APART).stop <= episode_seeds(1, 0, 1).start
    assert first_online_seed(1) - first_online_seed(0) >= SEEDS_APART


def test_episodes_that_datasets_may_have_are_refused_to_an_evaluation():
    check_unlearned(SEEDS_APART - 500, 500)
    with pytest.raises(ConfigError, match="--seed: episodes from 1000000 on are learned from"):
        check_unlearned(SEEDS_APART - 499, 500)
