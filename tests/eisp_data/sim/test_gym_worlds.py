"""Any GoalEnv behind the interface of the worlds."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from eisp_data.collect import explore
from eisp_data.errors import ConfigError
from eisp_data.sim.gym_worlds import GymWorlds


class Line(gymnasium.Env):
    """A point on a line from -10 to 10 that ends at the goal; its actions are in [0, 4]."""

    def __init__(self, patience=99):
        box = spaces.Box(-10.0, 10.0, (1,), np.float64)
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = spaces.Box(0.0, 4.0, (1,), np.float32)
        self.patience, self.left = patience, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = np.zeros(1), self.np_random.uniform(5, 6, 1)
        self.left = self.patience
        return self._seen(), {}

    def _seen(self):
        return {"observation": self.place, "achieved_goal": self.place, "desired_goal": self.goal}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -abs(achieved_goal[0] - desired_goal[0])

    def step(self, action):
        assert self.action_space.contains(action) and self.left > 0
        self.left -= 1
        self.place = self.place + action
        done = bool(self.place[0] >= self.goal[0])
        return self._seen(), 0.0, done, self.left == 0, {"is_success": done}


class VectorisedLine(Line):
    """Its rewards are an array whatever it is asked for, as replay buffers want it."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(np.atleast_2d(achieved_goal - desired_goal)).sum(1)


@pytest.fixture(autouse=True, scope="module")
def registered():
    gymnasium.register("Line-v0", Line, max_episode_steps=8)
    gymnasium.register("VectorisedLine-v0", VectorisedLine, max_episode_steps=8)
    gymnasium.register("ImpatientLine-v0", Line, max_episode_steps=8, kwargs={"patience": 3})
    gymnasium.register("Endless-v0", Line)
    yield
    for name in ("Line-v0", "VectorisedLine-v0", "ImpatientLine-v0", "Endless-v0"):
        del gymnasium.registry[name]


def fetch_actions(count):
    return np.random.default_rng(0).uniform(-1, 1, (count, 2, 4)).astype(np.float32)


def test_sizes_are_those_of_the_environment():
    worlds = GymWorlds("FetchPickAndPlace-v4", 2)
    sizes = (worlds.observation_dim, worlds.goal_dim, worlds.action_dim, worlds.episode_steps)
    assert sizes == (25, 3, 4, 50)


def test_worlds_are_those_that_gymnasium_makes():
    worlds = GymWorlds("FetchPickAndPlace-v4", 2)
    worlds.reset([3, 4])
    env = gymnasium.make("FetchPickAndPlace-v4")
    seen, _ = env.reset(seed=4)
    assert np.array_equal(worlds.desired_goal[1], seen["desired_goal"].astype(np.float32))
    for action in fetch_actions(5):
        worlds.step(action)
        seen = env.step(action[1])[0]
    assert np.array_equal(worlds.observation[1], seen["observation"].astype(np.float32))


def test_a_snapshot_is_gone_on_from_exactly():
    worlds = GymWorlds("FetchPickAndPlace-v4", 2)
    worlds.reset([3, 4])
    actions = fetch_actions(12)
    for action in actions[:6]:
        worlds.step(action)
    snapshot = worlds.snapshot()
    for action in actions[6:]:
        worlds.step(action)
    after = worlds.observation.copy()
    again = GymWorlds("FetchPickAndPlace-v4", 2)
    again.restore_snapshot(snapshot)
    for action in actions[6:]:
        again.step(action)
    assert np.array_equal(again.observation, after)
    assert np.array_equal(again.steps, [12, 12])


def test_actions_are_scaled_to_the_environments_own():
    worlds = GymWorlds("Line-v0", 3)
    worlds.reset([0, 1, 2])
    worlds.step(np.array([[-1.0], [0.0], [7.0]]))
    assert np.allclose(worlds.observation[:, 0], [0.0, 2.0, 4.0])


def test_a_world_that_is_over_waits_for_its_reset():
    worlds = GymWorlds("Line-v0", 1)
    worlds.reset([0])
    for _ in range(4):
        worlds.step(np.ones((1, 1)))
    assert worlds.done[0] and worlds.success[0]
    assert worlds.steps[0] == 2
    worlds.reset([0])
    assert not worlds.done[0] and not worlds.success[0]


def test_an_episode_ends_where_the_environment_ends_it():
    (episode,) = explore(GymWorlds("Line-v0", 1), [5])
    assert episode.done[-1] != episode.truncated[-1]
    assert not episode.done[:-1].any()
    assert np.allclose(episode.reward, -np.abs(episode.achieved_goal[1:, 0] - episode.desired_goal))


@pytest.mark.parametrize("env_id", ["Line-v0", "VectorisedLine-v0"])
def test_rewards_are_those_of_each_row_whether_or_not_the_environment_takes_many(env_id):
    achieved, desired = np.array([[1.0], [2.0], [5.0]]), np.array([[1.5], [5.0], [5.0]])
    reward = GymWorlds(env_id, 1).compute_reward(achieved, desired)
    assert reward.dtype == np.float32
    assert reward.tolist() == [-0.5, -3.0, 0.0]


def test_an_episode_that_the_environment_cuts_off_early_waits_for_its_reset():
    worlds = GymWorlds("ImpatientLine-v0", 1)
    worlds.reset([0])
    for _ in range(5):
        worlds.step(np.full((1, 1), -1.0))
    assert worlds.truncated[0] and not worlds.done[0]
    assert worlds.steps[0] == 3
    again = GymWorlds("ImpatientLine-v0", 1)
    again.restore_snapshot(worlds.snapshot())
    assert again.truncated[0] and again.steps[0] == 3
    worlds.reset([0])
    assert not worlds.truncated[0]
    episodes = list(explore(worlds, range(6)))
    assert max(len(episode) for episode in episodes) == 3
    assert any(episode.truncated[-1] for episode in episodes)


def test_random_episodes_depend_on_their_seeds_alone():
    alone = list(explore(GymWorlds("Line-v0", 1), range(6)))
    beside = list(explore(GymWorlds("Line-v0", 4), range(6)))
    for one, other in zip(alone, beside, strict=True):
        assert np.array_equal(one.action, other.action)
        assert np.array_equal(one.observation, other.observation)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("CartPole-v1", "not a GoalEnv"),
        ("Nope-v0", "FetchPickAndPlace-v4"),
        ("no_such_module:Env-v0", "no_such_module"),
        ("Endless-v0", "max_episode_steps"),
    ],
)
def test_what_cannot_be_used_is_named(env_id, message):
    with pytest.raises(ConfigError) as caught:
        GymWorlds(env_id, 1)
    assert env_id in str(caught.value)
    assert message in str(caught.value)
