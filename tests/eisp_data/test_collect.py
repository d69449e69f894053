"""How an episode that is recorded comes to its end."""

import numpy as np

from eisp_data.collect import record
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import get_task


class Dropping:
    """Does nothing; in the worlds of odd seeds the first block begins beyond the table's edge."""

    def __init__(self, worlds: Worlds) -> None:
        self.finished = np.zeros(worlds.count, bool)
        self._worlds = worlds

    def begin(self, world: int, seed: int) -> None:
        if seed % 2:
            task, state = self._worlds.task, self._worlds.state
            block = task.block_positions(state)[world, 0]
            state[world, np.flatnonzero(np.isclose(state[world], block[0]))] += 2.0

    def act(self) -> np.ndarray:
        return np.zeros((self._worlds.count, self._worlds.action_dim), np.float32)


def test_an_episode_ends_where_a_block_has_fallen_off_the_table():
    worlds = Worlds(get_task("stack"), 2, threads=1)
    kept, fallen = record(worlds, Dropping(worlds), [0, 1], {})
    assert len(kept) == worlds.episode_steps
    heights = fallen.achieved_goal.reshape(len(fallen) + 1, -1, 3)[..., 2].min(1)
    assert heights[-1] < 0.0 <= heights[-4] and len(fallen) < 30
    assert fallen.truncated[-1] and not fallen.done.any()
