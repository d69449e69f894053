"""Which achieved goals serve as subgoals and goals: worked examples, and what holds for all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_samples import path_of

from pretrain.hindsight import Waypoints, at_rest, evenly, find_waypoints, moves

OBJECTS = 3
few = settings(max_examples=40, deadline=None)
stretches = st.lists(
    st.tuples(st.none() | st.integers(0, OBJECTS - 1), st.integers(1, 8)), min_size=1, max_size=10
)
episodes = st.lists(stretches, min_size=1, max_size=4)
cuts = st.none() | st.integers(1, 5)


def joined_paths(found: list[list[tuple[int | None, int]]]) -> tuple[np.ndarray, np.ndarray]:
    paths = [path_of(OBJECTS, each) for each in found]
    return np.concatenate(paths), np.cumsum([0, *map(len, paths)])


@pytest.mark.parametrize(
    ("steps", "parts", "expected"),
    [(12, 4, [3, 6, 9, 12]), (300, 4, [75, 150, 225, 300]), (7, 1, [7]), (2, 4, [1, 1, 2, 2])],
)
def test_the_papers_waypoints_lie_evenly(steps, parts, expected):
    assert evenly(steps, parts).tolist() == expected


@few
@given(st.integers(1, 500), st.integers(1, 20))
def test_even_waypoints_increase_and_end_with_the_trajectory(steps, parts):
    found = evenly(steps, parts)
    assert len(found) == parts and found[0] >= 1 and found[-1] == steps
    assert (np.diff(found) > 0).all() if steps >= parts else (np.diff(found) >= 0).all()


def test_a_waypoint_is_where_things_have_come_to_rest():
    found = moves(path_of(2, [(None, 2), (0, 4), (None, 4), (1, 4), (None, 6)]))
    assert [(move.end, set(move.objects)) for move in found] == [(6, {0}), (14, {1})]


@pytest.mark.parametrize(("pause", "ends"), [(3, [9]), (4, [4, 10])])
def test_pauses_of_up_to_three_steps_do_not_end_a_move(pause, ends):
    found = moves(path_of(2, [(0, 4), (None, pause), (1, 2), (None, 2)]))
    assert [move.end for move in found] == ends


def test_moves_of_the_same_object_in_a_row_are_one():
    found = moves(path_of(2, [(0, 3), (None, 9), (0, 3), (None, 9), (1, 3), (None, 1)]))
    assert [(move.end, set(move.objects)) for move in found] == [(15, {0}), (27, {1})]


def test_a_move_that_the_end_cuts_off_is_none():
    assert moves(path_of(2, [(0, 5)])) == []
    assert [move.end for move in moves(path_of(2, [(0, 5), (None, 6), (1, 5)]))] == [5]


def test_what_comes_back_or_only_creeps_has_not_moved():
    back = path_of(1, [(0, 3), (None, 3)])
    back[2:] = back[0]
    assert moves(back) == []
    creeping = path_of(1, [(0, 40)]) * 0.1
    assert moves(creeping) == []


def test_objects_that_move_together_move_at_once():
    path = path_of(2, [(0, 4), (None, 2)])
    path[:, 3:] = path[:, :3] + 0.2
    assert [(move.end, set(move.objects)) for move in moves(path)] == [(4, {0, 1})]


@pytest.mark.parametrize("goal_dim", [1, 2, 4, 7])
def test_a_goal_that_is_no_set_of_places_counts_as_one_object(goal_dim):
    path = np.zeros((9, goal_dim), np.float32)
    path[2:, -1] = 0.05
    assert [(move.end, set(move.objects)) for move in moves(path)] == [(2, {0})]


def test_one_may_look_ahead_until_an_object_is_taken_up_again():
    ends, beyond = at_rest(path_of(2, [(0, 3), (None, 5), (1, 3), (None, 5), (0, 3), (None, 5)]))
    assert ends.tolist() == [3, 11, 19]
    assert beyond.tolist() == [2, 3, 3]


def test_what_is_opened_and_closed_again_for_something_in_between_is_no_detour():
    path = path_of(2, [(0, 5), (None, 5), (1, 5), (None, 5), (0, 5), (None, 5)])
    closing = slice(20, 26)
    # The drawer, object 0, goes back to where it began, and takes what is inside with it.
    path[closing, 0] = np.linspace(path[20, 0], path[0, 0], 6)
    path[26:, 0] = path[0, 0]
    path[closing, 3] -= np.linspace(0.0, 0.03, 6, dtype=np.float32)
    path[26:, 3] = path[25, 3]
    ends, beyond = at_rest(path)
    assert ends.tolist() == [5, 15, 25]
    assert beyond.tolist() == [3, 3, 3]


@few
@given(stretches)
def test_every_move_on_the_way_to_a_goal_takes_up_something_new_or_brings_it_back(each):
    path = path_of(OBJECTS, each)
    found = [move.objects for move in moves(path)]
    ends, beyond = at_rest(path)
    assert (np.diff(ends) > 0).all()
    for first, last in enumerate(beyond.tolist()):
        seen: set[int] = set()
        for objects in found[first:last]:
            # Nothing comes back in these paths.
            assert objects - seen
            seen |= objects
        assert last == len(found) or found[last] <= seen


@few
@given(episodes, cuts)
def test_every_row_is_followed_by_the_first_waypoint_after_it_in_its_episode(found, parts):
    goals, starts = joined_paths(found)
    waypoints = find_waypoints(goals, starts, parts)
    assert (np.diff(waypoints.row) >= 0).all()
    for start, stop in zip(starts, starts[1:], strict=False):
        inside = waypoints.row[(waypoints.row >= start) & (waypoints.row < stop)]
        for row in range(start, stop):
            after, index = inside[inside > row], waypoints.following[row]
            assert (index < 0) == (len(after) == 0)
            assert index < 0 or waypoints.row[index] == after[0]
            assert index < 1 or waypoints.row[index - 1] <= row


@few
@given(episodes, cuts, st.integers(0, 2**32 - 1))
def test_a_goal_is_in_the_same_episode_at_or_after_the_subgoal_and_no_detour(found, parts, seed):
    goals, starts = joined_paths(found)
    waypoints = find_waypoints(goals, starts, parts)
    rows = np.repeat(np.flatnonzero(waypoints.following >= 0), 3)
    subgoal, goal = waypoints.subgoal_and_goal(rows, 0.5, np.random.default_rng(seed))
    assert (rows < subgoal).all() and (subgoal <= goal).all()
    episode = np.searchsorted(starts, [rows, subgoal, goal], side="right")
    assert (episode == episode[0]).all()
    beyond = waypoints.beyond[waypoints.following[rows]]
    assert (goal <= waypoints.row[beyond - 1]).all()


@few
@given(episodes, cuts)
def test_every_goal_that_is_no_detour_is_drawn(found, parts):
    goals, starts = joined_paths(found)
    waypoints = find_waypoints(goals, starts, parts)
    leading = np.flatnonzero(waypoints.following >= 0)[:1]
    if len(leading):
        first = waypoints.following[leading[0]]
        allowed = set(waypoints.row[first : waypoints.beyond[first]].tolist())
        rows, rng = np.repeat(leading, 500), np.random.default_rng(0)
        assert set(waypoints.subgoal_and_goal(rows, 0.5, rng)[1].tolist()) == allowed
        assert set(waypoints.subgoal_and_goal(rows, 1.0, rng)[1].tolist()) == {max(allowed)}


@pytest.mark.parametrize("parts", [None, 3])
def test_no_episodes_have_no_waypoints(parts):
    waypoints = find_waypoints(np.empty((0, 9), np.float32), np.zeros(1, np.int64), parts)
    assert len(waypoints.row) == len(waypoints.following) == len(waypoints.beyond) == 0


def assert_equal(ours: Waypoints, theirs: Waypoints) -> None:
    np.testing.assert_array_equal(ours.row, theirs.row)
    np.testing.assert_array_equal(ours.following, theirs.following)
    np.testing.assert_array_equal(ours.beyond, theirs.beyond)


@few
@given(episodes, episodes, cuts)
def test_joining_waypoints_is_finding_them_in_all_rows(earlier, later, parts):
    both = find_waypoints(*joined_paths(earlier + later), parts)
    first = find_waypoints(*joined_paths(earlier), parts)
    assert_equal(first.joined(find_waypoints(*joined_paths(later), parts)), both)


@few
@given(episodes, st.data(), cuts)
def test_dropping_the_first_episodes_is_finding_waypoints_in_the_others(found, data, parts):
    count = data.draw(st.integers(0, len(found) - 1))
    goals, starts = joined_paths(found)
    dropped = find_waypoints(goals, starts, parts).without_first(int(starts[count]))
    assert_equal(dropped, find_waypoints(*joined_paths(found[count:]), parts))
