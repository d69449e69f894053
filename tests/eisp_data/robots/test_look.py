"""A look leads up, out of the camera's way and back, and waits for what it is there to see."""

from __future__ import annotations

import numpy as np

from eisp_data.robots.look import LOOK_FROM_M, Look
from eisp_data.sim.scene import FINGER_TRAVEL_M
from eisp_data.tasks.base import ACTION_SCALE_M

START_M = np.array([0.40, 0.15, 0.03])
OPEN_M = 2 * FINGER_TRAVEL_M


def follow(look: Look, opening_m: float, seen_from_tick: int = 0, moves: bool = True):
    """Return places (N, 3) and actions (N, 4) until the look is over."""
    places, actions = [START_M], []
    for tick in range(1000):
        action = look.step(places[-1], opening_m, sees_all=tick >= seen_from_tick)
        if action is None:
            break
        actions.append(action)
        places.append(places[-1] + moves * ACTION_SCALE_M * action[:3])
    return np.array(places), np.array(actions)


def test_it_rises_before_it_leaves_and_ends_over_the_table():
    places, actions = follow(Look(START_M, opens=False, holds=False), OPEN_M)
    low = places[:, 2] < LOOK_FROM_M[2] - 0.03
    beside = np.linalg.norm(places[:, :2] - START_M[:2], axis=1) > 0.01
    last_from = np.linalg.norm(places - LOOK_FROM_M, axis=1).argmin()
    assert not (low & beside)[:last_from].any()
    assert np.linalg.norm(places[last_from] - LOOK_FROM_M) < 0.03
    assert places[-1][2] < LOOK_FROM_M[2] - 0.05
    assert (np.abs(actions[:, :3]) <= 0.25).all()


def test_it_waits_where_it_sees_all_until_it_does_but_not_for_ever():
    at_once = len(follow(Look(START_M, opens=False, holds=False), OPEN_M)[1])
    later = len(
        follow(Look(START_M, opens=False, holds=False), OPEN_M, seen_from_tick=at_once + 10)[1]
    )
    never = len(follow(Look(START_M, opens=False, holds=False), OPEN_M, seen_from_tick=10_000)[1])
    assert at_once < later < never < at_once + 200


def test_fingers_stay_as_they_are_or_open_once_the_arm_has_risen():
    _, actions = follow(Look(START_M, opens=False, holds=False), 0.02)
    np.testing.assert_allclose(actions[:, 3], -0.5)
    places, actions = follow(Look(START_M, opens=True, holds=False), 0.02)
    low = places[:-1, 2] < LOOK_FROM_M[2] - 0.03
    until = np.linalg.norm(places - LOOK_FROM_M, axis=1).argmin()
    np.testing.assert_allclose(actions[:until][low[:until], 3], -0.5)
    np.testing.assert_allclose(actions[until:, 3], 1.0)


def test_what_is_held_is_let_go_of_before_anything_moves():
    _, actions = follow(Look(START_M, opens=True, holds=True), 0.05)
    assert (actions[:10] == [0.0, 0.0, 0.0, 1.0]).all()
    assert actions[:, 2].max() > 0 and (actions[:, 3] == 1.0).all()
    _, actions = follow(Look(START_M, opens=True, holds=True), OPEN_M)
    assert actions[0, 2] > 0


def test_an_arm_that_cannot_move_ends_its_look_all_the_same():
    _, actions = follow(Look(START_M, opens=True, holds=True), OPEN_M, moves=False)
    assert len(actions) < 300
