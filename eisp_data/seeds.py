"""Which seeds are whose: nothing is evaluated on an episode that was learned or chosen from."""

from __future__ import annotations

from eisp_data.errors import ConfigError

SEEDS_APART = 1_000_000
"""How many seeds each dataset has; the first as many are left to evaluations."""
LAST_SEED = 498
"""Of a dataset: the seeds of its episodes end where ``SELECTION_SEED`` begins."""
SELECTION_SEED = 500_000_000
"""Seeds from here on choose among checkpoints; none of them is ever reported on."""
_LEARNING_SEED = 1_000_000_000
_LEARNING_APART = 10_000_000


def episode_seeds(seed: int, start: int, stop: int) -> range:
    """Return the seeds of episodes ``start`` to ``stop - 1`` of a dataset."""
    first = (seed + 1) * SEEDS_APART
    return range(first + start, first + stop)


def check_unlearned(seed: int, episodes: int) -> None:
    """Raise ConfigError unless these episodes are left to evaluations."""
    if seed + episodes > SEEDS_APART:
        raise ConfigError(
            f"--seed: episodes from {SEEDS_APART} on are learned from; got {seed} and {episodes} "
            "episodes"
        )


def first_online_seed(seed: int) -> int:
    """Return the first seed of the worlds that a run learns in online."""
    return _LEARNING_SEED + seed * _LEARNING_APART
