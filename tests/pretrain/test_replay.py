"""Batches of transitions, and what relabelling their goals may and may not do."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_samples import path_of

from eisp_data.tasks.base import SUCCESS_DISTANCE_M, is_success
from pretrain.config import GoalMix
from pretrain.hindsight import find_waypoints
from pretrain.layout import Layout, ObjectIndex
from pretrain.replay import Trajectories

OBJECTS = 3
LAYOUT = Layout(2, 9, 1, objects=tuple(ObjectIndex(0, 0, 3 * i) for i in range(OBJECTS)))
PLAIN = Layout(2, 9, 1)
COUNT = 400
EPISODES = (
    [(None, 4), (0, 6), (None, 8), (1, 5), (None, 7)],
    [(2, 9), (None, 6), (0, 7), (None, 5), (2, 8), (None, 9)],
    [(None, 12)],
    [(1, 30)],
)
# Goals are jittered by a share of the tolerance: with next to none, one sees where they come from.
EXACT_M = 1e-6
WAYPOINT = GoalMix(waypoint=1.0, future=0.0, displaced=0.0, horizon=15, tolerance_m=EXACT_M)
FUTURE = GoalMix(waypoint=0.0, future=1.0, displaced=0.0, horizon=15, tolerance_m=EXACT_M)
DISPLACED = GoalMix(waypoint=0.0, future=0.0, displaced=1.0, horizon=15, tolerance_m=EXACT_M)
PURSUED = GoalMix(waypoint=0.0, future=0.0, displaced=0.0, pursued=1.0, tolerance_m=EXACT_M)
MIXED = GoalMix(waypoint=0.3, future=0.4, displaced=0.3, horizon=15, tolerance_m=EXACT_M)


def trajectories(
    episodes=EPISODES, *, parts=None, purposeful=True, layout=LAYOUT, data=None
) -> Trajectories:
    """Return trajectories of which every observation says row and episode."""
    if data is None:
        data = Trajectories(layout, 10**6, parts, purposeful=purposeful)
    paths = [path_of(OBJECTS, each) for each in episodes]
    starts = np.cumsum([0, *map(len, paths)])
    rows = np.arange(starts[-1], dtype=np.float32)
    episode = np.searchsorted(starts, rows, side="right") - 1
    observation = np.stack([rows, episode], 1).astype(np.float32)
    # Objects lie elsewhere in every episode, so that places tell episodes apart.
    achieved = np.concatenate([p + np.float32(2.0 * i) for i, p in enumerate(paths)])
    # No object ever gets where it is pursued to, a place of each row's own.
    pursued = np.repeat(100 + rows[:, None], layout.goal_dim, axis=1)
    data.extend(observation, achieved, rows[:, None] / 1000, pursued, starts)
    return data


def draw(data: Trajectories, mix: GoalMix, seed: int = 0):
    """Return a batch, its rows and the goals as arrays."""
    batch = data.transitions(COUNT, mix, np.random.default_rng(seed))
    return batch, batch.observation[:, 0].long().numpy(), batch.goal.numpy()


def last_row(data: Trajectories, rows: np.ndarray) -> np.ndarray:
    return data.episode_start[np.searchsorted(data.episode_start, rows, side="right")] - 1


def same(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return, for each component, whether two goals are the same."""
    return np.isclose(ours, theirs, rtol=0, atol=2e-5)


def rows_of(data: Trajectories, goal: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return whether each goal was achieved later in the episode of its row."""
    last = last_row(data, rows)
    return np.array(
        [
            same(data.achieved_goal[row + 1 : end + 1], wanted).all(1).any()
            for row, end, wanted in zip(rows, last, goal, strict=True)
        ]
    )


@pytest.mark.parametrize("mix", [WAYPOINT, FUTURE, DISPLACED, MIXED])
@pytest.mark.parametrize("tolerance_m", [0.01, 0.05])
def test_the_reward_is_eq_1_for_the_relabelled_goal(mix, tolerance_m):
    data = trajectories()
    mix = replace(mix, tolerance_m=tolerance_m)
    batch, rows, goal = draw(data, mix)
    distance = np.linalg.norm(data.achieved_goal[rows + 1] - goal, axis=1)
    assert batch.reward.tolist() == np.where(distance <= tolerance_m, 0.0, -1.0).tolist()
    assert set(batch.reward.tolist()) <= {0.0, -1.0}


def test_goals_stay_so_near_to_what_was_achieved_that_it_counts():
    data = trajectories()
    for mix in (WAYPOINT, FUTURE):
        (_, _, exact), (_, _, goal) = (
            draw(data, replace(mix, tolerance_m=each)) for each in (EXACT_M, 0.05)
        )
        assert (np.linalg.norm(goal - exact, axis=1) <= 0.05).mean() > 0.95


def test_at_five_centimetres_the_reward_is_that_of_the_tasks():
    data = trajectories()
    batch, rows, goal = draw(data, replace(MIXED, tolerance_m=SUCCESS_DISTANCE_M))
    expected = is_success(data.achieved_goal[rows + 1], goal)
    assert (batch.reward.numpy() == expected - 1.0).all()


@pytest.mark.parametrize("mix", [WAYPOINT, FUTURE, DISPLACED])
def test_a_transition_is_two_rows_of_an_episode_and_the_action_between(mix):
    batch, rows, _ = draw(trajectories(), mix)
    assert (batch.next_observation[:, 0] == batch.observation[:, 0] + 1).all()
    assert (batch.next_observation[:, 1] == batch.observation[:, 1]).all()
    assert (batch.action[:, 0].numpy() == (rows / 1000).astype(np.float32)).all()


@pytest.mark.parametrize("purposeful", [True, False])
def test_a_waypoint_goal_is_the_next_waypoint_or_at_last_how_a_demonstration_ends(purposeful):
    data = trajectories(purposeful=purposeful)
    _, rows, goal = draw(data, WAYPOINT)
    following = data.waypoints.following[rows]
    source = np.where(following < 0, last_row(data, rows), data.waypoints.row[following])
    assert same(goal, data.achieved_goal[source]).all()
    assert (following < 0).any() == purposeful


def test_a_future_goal_is_achieved_within_the_horizon():
    data = trajectories()
    _, rows, goal = draw(data, FUTURE)
    assert rows_of(data, goal, rows).all()
    assert FUTURE.horizon is not None
    near = np.minimum(rows + FUTURE.horizon, last_row(data, rows))
    distance = np.abs(goal - data.achieved_goal[rows]).max(1)
    most = np.abs(data.achieved_goal[near] - data.achieved_goal[rows]).max(1)
    assert (distance <= most + 2e-5).all()


def test_without_a_horizon_a_future_goal_is_any_later_row_of_the_trajectory_alike():
    data = trajectories(([(0, 30)], [(1, 30)]))
    shares = []
    for seed in range(20):
        _, rows, goal = draw(data, replace(FUTURE, horizon=None), seed)
        found = np.abs(data.achieved_goal[:, None] - goal).max(-1).argmin(0)
        assert (rows < found).all() and (found <= last_row(data, rows)).all()
        shares.append((found - rows) / (last_row(data, rows) - rows))
    # Of n later rows the k-th: k / n is (n + 1) / 2n on average.
    _, rows, _ = draw(data, FUTURE)
    left = last_row(data, rows) - rows
    assert np.mean(shares) == pytest.approx(((left + 1) / (2 * left)).mean(), abs=0.02)


def test_a_displaced_goal_moves_one_object_to_where_it_lay_at_another_time():
    data = trajectories()
    _, rows, goal = draw(data, DISPLACED)
    differs = (~same(goal, data.achieved_goal[rows])).reshape(COUNT, OBJECTS, 3).any(2)
    assert (differs.sum(1) <= 1).all() and differs.any(0).all()
    places = data.achieved_goal.reshape(len(data), OBJECTS, 3)
    for row in np.flatnonzero(differs.any(1)):
        which = int(differs[row].argmax())
        wanted = goal[row].reshape(OBJECTS, 3)[which]
        assert same(places, wanted).all(-1).any()


def test_without_objects_a_displaced_goal_is_any_that_was_achieved():
    data = trajectories(layout=PLAIN)
    _, rows, goal = draw(data, DISPLACED)
    assert same(goal[:, None], data.achieved_goal).all(-1).any(1).all()
    assert (~same(goal, data.achieved_goal[rows])).any(1).mean() > 0.5


@pytest.mark.parametrize("purposeful", [True, False])
def test_only_actions_that_went_on_to_the_goal_are_cloned(purposeful):
    data = trajectories(purposeful=purposeful)
    for mix in (WAYPOINT, FUTURE, MIXED):
        batch, rows, goal = draw(data, mix)
        cloned = batch.clone.numpy() == 1
        assert cloned.any() and not cloned.all()
        assert rows_of(data, goal[cloned], rows[cloned]).all()
        moved = np.linalg.norm(goal - data.achieved_goal[rows], axis=1) > 0.009
        at_the_end = same(goal, data.achieved_goal[last_row(data, rows)]).all(1)
        assert (moved | at_the_end)[cloned].all()
    assert (draw(data, DISPLACED)[0].clone == 0).all()


@pytest.mark.parametrize("purposeful", [True, False])
def test_a_batch_says_whether_it_was_demonstrated(purposeful):
    batch, _, _ = draw(trajectories(purposeful=purposeful), MIXED)
    assert (batch.demonstrated == float(purposeful)).all()


def test_where_nothing_ever_rests_goals_are_future_ones():
    data = trajectories([[(0, 20)], [(1, 20)]], purposeful=False)
    _, rows, goal = draw(data, WAYPOINT)
    assert len(data.leading) == 0
    assert rows_of(data, goal, rows).all()


def test_subgoals_are_the_next_waypoint_and_goals_one_at_or_after_it():
    for parts in (None, 4):
        data = trajectories(parts=parts)
        observation, goal, subgoal = data.subgoals(COUNT, MIXED, np.random.default_rng(0))
        rows = observation[:, 0].long().numpy()
        following = data.waypoints.following[rows]
        assert (following >= 0).all()
        assert (subgoal.numpy() == data.achieved_goal[data.waypoints.row[following]]).all()
        for first, last, wanted in zip(
            following, data.waypoints.beyond[following], goal.numpy(), strict=True
        ):
            allowed = data.achieved_goal[data.waypoints.row[first:last]]
            assert same(allowed, wanted).all(1).any()


@pytest.mark.parametrize(("purposeful", "share"), [(True, 0.25), (True, 0.0), (False, 0.25)])
def test_a_share_of_subgoals_leads_to_the_very_goal_of_a_demonstration(purposeful, share):
    data = Trajectories(LAYOUT, 10**6, None, purposeful=purposeful)
    paths = [path_of(OBJECTS, each) + np.float32(2.0 * i) for i, each in enumerate(EPISODES)]
    starts = np.cumsum([0, *map(len, paths)])
    rows = np.arange(starts[-1], dtype=np.float32)
    pursued = np.repeat(100 + rows[:, None], LAYOUT.goal_dim, axis=1)
    # The second episode alone ends, at rest, two centimetres from its goal.
    pursued[starts[1] : starts[2]] = paths[1][-1] + np.eye(9, dtype=np.float32)[0] * 0.02
    observation, achieved = np.stack([rows, rows], 1), np.concatenate(paths)
    met = np.linalg.norm(achieved - pursued, axis=1) <= 0.05 if purposeful else None
    data.extend(observation, achieved, rows[:, None], pursued, starts, success=met)
    mix = replace(MIXED, complete=share)
    observation, goal, _ = data.subgoals(COUNT, mix, np.random.default_rng(0))
    rows = observation[:, 0].long().numpy()
    second = (rows >= starts[1]) & (rows < starts[2])
    first = second[: COUNT // 4]
    assert first.all() == (purposeful and share > 0)
    assert not second[COUNT // 4 :].all()
    if first.all():
        assert same(goal[: COUNT // 4].numpy(), paths[1][-1]).all()


def test_waypoints_are_where_objects_rest_whatever_the_goals_look_like():
    paths = [path_of(OBJECTS, each) for each in EPISODES]
    starts = np.cumsum([0, *map(len, paths)])
    looks = np.random.default_rng(0).random((starts[-1], 5), np.float32)
    seen = Trajectories(Layout(2, 5, 1), 10**6, None, purposeful=True)
    seen.extend(looks[:, :2], looks, looks[:, :1], looks, starts, np.concatenate(paths))
    np.testing.assert_array_equal(seen.waypoints.row, trajectories().waypoints.row)


def test_what_an_image_looks_like_is_no_part_of_its_distance():
    layout = Layout(2, 9 + 4, 1, latent_dim=4)
    paths = [path_of(OBJECTS, each) for each in EPISODES]
    starts = np.cumsum([0, *map(len, paths)])
    looks = np.random.default_rng(0).random((starts[-1], 4), np.float32)
    goals = np.hstack([np.concatenate(paths), looks])
    data = Trajectories(layout, 10**6, None, purposeful=True)
    data.extend(looks[:, :2], goals, looks[:, :1], goals, starts, goals[:, :9])
    batch = data.transitions(COUNT, replace(FUTURE, tolerance_m=0.02), np.random.default_rng(0))
    goal = batch.goal.numpy()
    here = [(looks == row).all(1).argmax() for row in goal[:, 9:]]
    assert (looks[here] == goal[:, 9:]).all(), "latents of goals are left as they are"
    assert not (goals[here, :9] == goal[:, :9]).all(), "places are jittered"
    after = [(looks[:, :2] == row).all(1).argmax() for row in batch.next_observation.numpy()]
    near = np.linalg.norm(goals[after, :9] - goal[:, :9], axis=1) <= 0.02
    assert 0 < near.sum() < COUNT
    assert (batch.reward.numpy() == near - 1.0).all()


def test_pursued_goals_are_exactly_those_of_the_row_and_never_cloned():
    batch, rows, goal = draw(trajectories(), PURSUED)
    np.testing.assert_array_equal(goal, np.repeat(100.0 + rows[:, None], goal.shape[1], axis=1))
    assert (batch.reward == -1).all() and (batch.clone == 0).all()


def test_a_pursued_goal_that_is_met_is_rewarded():
    data = trajectories()
    data.pursued[:-1] = data.achieved_goal[1:]
    batch, _, _ = draw(data, PURSUED)
    assert (batch.reward == 0).all()


def test_equal_seeds_draw_equal_batches():
    data = trajectories()
    first, again = (draw(data, MIXED, seed=3)[0] for _ in range(2))
    other = draw(data, MIXED, seed=4)[0]
    assert torch.equal(first.goal, again.goal) and torch.equal(first.action, again.action)
    assert not torch.equal(first.goal, other.goal)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.lists(st.integers(1, 9), min_size=1, max_size=3), min_size=1, max_size=5),
    st.integers(11, 60),
    st.none() | st.integers(1, 4),
)
def test_capacity_drops_whole_oldest_episodes_and_no_more(batches, capacity, parts):
    data = Trajectories(LAYOUT, capacity, parts, purposeful=False)
    lengths: list[int] = []
    everything = []
    for lot in batches:
        trajectories([[(0, n), (None, 1)] for n in lot], data=data)
        lengths += [n + 2 for n in lot]
        everything += [path_of(OBJECTS, [(0, n), (None, 1)]) + np.float32(2.0 * i)
                       for i, n in enumerate(lot)]  # fmt: skip
    kept = [i for i in range(len(lengths)) if sum(lengths[i:]) <= capacity]
    assert np.diff(data.episode_start).tolist() == lengths[kept[0] :]
    expected = np.concatenate(everything[kept[0] :])
    np.testing.assert_array_equal(data.achieved_goal, expected)
    assert (
        len(data.observation)
        == len(data.action)
        == len(data.pursued)
        == len(data)
        == data.episode_start[-1]
    )
    fresh = find_waypoints(expected, data.episode_start, parts)
    np.testing.assert_array_equal(data.waypoints.row, fresh.row)
    np.testing.assert_array_equal(data.waypoints.following, fresh.following)
    ends = set((data.episode_start[1:] - 1).tolist())
    assert set(range(len(data))) - set(data.acting.tolist()) == ends


def test_moments_are_those_of_the_data_and_one_where_nothing_varies():
    data = trajectories()
    moments = data.moments()
    np.testing.assert_allclose(moments["observation_mean"], data.observation.mean(0), rtol=1e-5)
    np.testing.assert_allclose(moments["observation_std"], data.observation.std(0), rtol=1e-4)
    still = trajectories([[(0, 9)]], parts=1)
    still.achieved_goal[:, 1] += np.resize([0.0, 1e-4], len(still))
    std = still.moments()["goal_std"]
    assert (std[1:] == 1).all() and 0 < std[0] < 1
    standardised = (torch.from_numpy(still.achieved_goal) - still.moments()["goal_mean"]) / std
    assert standardised.isfinite().all() and standardised[:, 1:].abs().amax() < 1e-3
