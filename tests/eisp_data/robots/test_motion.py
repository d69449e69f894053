"""Displacements become smooth joint targets, and ways lead round what is in the way."""

import numpy as np
import pinocchio as pin
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots.arms import ARMS, get_arm, joint_limits
from eisp_data.robots.collision import CollisionChecker
from eisp_data.robots.kinematics import Kinematics
from eisp_data.robots.motion import CartesianServo, fingers_down, joint_path
from eisp_data.robots.planning import plan
from eisp_data.robots.safety import SafetyConfig
from eisp_data.sim.scene import FINGER_TRAVEL_M, WORKSPACE_HIGH_M
from eisp_data.tasks.base import ACTION_SCALE_M

HZ = 25.0


def start_at(arm, point):
    kinematics = Kinematics(arm)
    pose = fingers_down(np.array(point), get_arm(arm).transform_task_to_base)
    return kinematics, kinematics.inverse(pose, kinematics.home)


def drive(servo, posture, actions):
    rows = [posture]
    for action in actions:
        rows.append(servo.step(np.asarray(action, float), rows[-1]).joint_position)
    return np.stack(rows), np.stack([servo.tool_in_task(row) for row in rows])


@pytest.mark.parametrize("arm", ARMS)
def test_an_action_moves_the_tool_its_way_at_the_trained_speed(arm):
    kinematics, posture = start_at(arm, (0.25, -0.12, 0.10))
    servo = CartesianServo(arm, HZ)
    action = np.array([0.3, 0.4, 0.1, 1.0])
    rows, places = drive(servo, posture, [action] * 8)
    np.testing.assert_allclose(places[-1] - places[-2], ACTION_SCALE_M * action[:3], atol=1e-4)
    down = np.stack([kinematics.forward(row)[:3, :3] for row in rows])
    np.testing.assert_allclose(down, np.broadcast_to(np.eye(3), down.shape), atol=1e-3)


def test_the_tool_speeds_up_and_slows_down_smoothly():
    _, posture = start_at("ur3", (0.25, 0.0, 0.15))
    servo = CartesianServo("ur3", HZ)
    _, places = drive(servo, posture, [[0.9, 0, 0, 0]] * 3 + [[0, 0, 0, 0]] * 6)
    change = np.diff(places, n=2, axis=0) * HZ**2
    assert np.linalg.norm(change, axis=1).max() < 8.5
    np.testing.assert_allclose(places[-1], places[-2], atol=1e-5)


def test_a_push_against_the_workspace_slides_along_it():
    _, posture = start_at("ur3", (0.30, 0.19, 0.15))
    servo = CartesianServo("ur3", HZ)
    _, places = drive(servo, posture, [[0.2, 1.0, 0.0, 0.0]] * 15)
    assert places[:, 1].max() < WORKSPACE_HIGH_M[1] + 1e-4
    assert places[-1, 0] > places[0, 0] + 0.05


def test_an_action_that_is_no_number_is_standing_still():
    _, posture = start_at("ur3", (0.30, 0.0, 0.15))
    servo = CartesianServo("ur3", HZ)
    rows, _ = drive(servo, posture, [[np.nan, 1.0, 0.0, 0.0], [np.inf, 0, 0, 0], [0, 0, np.nan, 1]])
    np.testing.assert_allclose(rows, np.broadcast_to(posture, rows.shape), atol=1e-4)


def test_the_fourth_action_opens_and_closes_the_gripper():
    _, posture = start_at("ur3", (0.30, 0.0, 0.15))
    servo = CartesianServo("ur3", HZ)
    openings = [servo.step(np.array([0, 0, 0, a]), posture).gripper_opening_m for a in (-9, 0, 9)]
    np.testing.assert_allclose(openings, [0.0, FINGER_TRAVEL_M, 2 * FINGER_TRAVEL_M])
    pushing = CartesianServo("ur3", HZ, fingers_closed=True)
    assert pushing.step(np.ones(4), posture).gripper_opening_m == 0.0


def test_an_arm_gives_way_to_where_it_was_pressed_but_not_out_of_the_workspace():
    _, inside = start_at("ur3", (0.30, 0.0, 0.15))
    _, outside = start_at("ur3", (0.30, 0.23, 0.15))
    servo = CartesianServo("ur3", HZ)
    np.testing.assert_array_equal(servo.give_way(inside), inside)
    place = servo.tool_in_task(servo.give_way(outside))
    np.testing.assert_allclose(place, [0.30, WORKSPACE_HIGH_M[1], 0.15], atol=1e-4)


def test_an_arm_that_was_pressed_out_of_the_workspace_stays_as_tilted_as_it_was():
    kinematics, outside = start_at("ur3", (0.30, 0.23, 0.15))
    tilted = outside + [0.0, 0.0, 0.0, 0.1, 0.1, 0.0]
    servo = CartesianServo("ur3", HZ)
    given = servo.give_way(tilted)
    assert servo.tool_in_task(given)[1] == pytest.approx(WORKSPACE_HIGH_M[1], abs=1e-4)
    turn = kinematics.forward(given)[:3, :3].T @ kinematics.forward(tilted)[:3, :3]
    np.testing.assert_allclose(turn, np.eye(3), atol=2e-3)


def test_a_tilted_arm_comes_upright_again_without_a_jump():
    kinematics, upright = start_at("ur3", (0.34, -0.02, 0.05))
    pose = kinematics.forward(upright)
    pose[:3, :3] = pose[:3, :3] @ pin.exp3(np.array([0.0, 0.3, 0.0]))
    servo = CartesianServo("ur3", HZ)
    rows, places = drive(servo, kinematics.track(pose, upright), [[0.0, 0.0, 0.0, 0.0]] * 12)
    assert np.abs(np.diff(rows, axis=0)).max() < SafetyConfig().jump_rad / 2
    np.testing.assert_allclose(places, np.broadcast_to(places[0], places.shape), atol=1e-3)
    np.testing.assert_allclose(kinematics.forward(rows[-1])[:3, :3], np.eye(3), atol=1e-3)


def test_half_the_speed_is_half_the_way():
    _, posture = start_at("ur3", (0.25, 0.0, 0.15))
    servo = CartesianServo("ur3", HZ, speed=0.5)
    _, places = drive(servo, posture, [[0.5, 0, 0, 0]] * 8)
    assert np.diff(places[:, 0])[-1] == pytest.approx(0.25 * ACTION_SCALE_M, abs=1e-4)


@pytest.mark.parametrize("arm", ARMS)
def test_a_joint_path_is_at_rest_at_its_ends_and_within_the_limits(arm):
    limits = joint_limits(arm)
    home = np.array(get_arm(arm).home)
    corners = np.stack([home, home + 0.4, home - 0.2])
    path = np.concatenate([home[None], joint_path(corners, limits, HZ)])
    np.testing.assert_allclose(path[-1], corners[-1], atol=1e-12)
    speed = np.diff(path, axis=0) * HZ
    change = np.diff(speed, axis=0, prepend=0.0 * speed[:1], append=0.0 * speed[:1]) * HZ
    assert (np.abs(speed) <= limits.velocity).all()
    assert (np.abs(change) <= limits.acceleration).all()


def test_nowhere_to_go_is_no_path():
    home = np.array(get_arm("ur3").home)
    path = joint_path(np.stack([home, home]), joint_limits("ur3"), HZ)
    np.testing.assert_array_equal(path, home[None])


def test_a_way_leads_round_a_wall():
    limits = joint_limits("ur3")
    start, goal = np.zeros(6), np.array([0.0, 1.5, 0, 0, 0, 0])

    def is_allowed(posture):
        # A wall across the straight way, open above 0.6 rad of the third joint.
        return not (0.6 < posture[1] < 0.9 and posture[2] < 0.6)

    way = plan(start, goal, limits, is_allowed, seed=1)
    np.testing.assert_array_equal(way[[0, -1]], [start, goal])
    assert len(way) > 2
    for one, other in zip(way[:-1], way[1:], strict=True):
        for share in np.linspace(0, 1, 200):
            between = one + share * (other - one)
            # Postures are looked at every 0.04 rad: so much of the wall's edge may be cut.
            assert is_allowed(between) or min(abs(between[1] - 0.6), abs(between[1] - 0.9)) < 0.04


def test_a_real_way_between_two_branches_is_free_of_collisions():
    checker, kinematics = CollisionChecker("ur3"), Kinematics("ur3")
    goal = kinematics.home.copy()
    goal[0] += 2.5
    way = plan(kinematics.home, goal, joint_limits("ur3"), checker.is_clear)
    assert all(map(checker.is_clear, joint_path(way, joint_limits("ur3"), HZ)))


def test_a_goal_that_collides_is_one_line():
    folded = np.array([0.0, -1.5, 2.9, -1.0, 0.0, 0.0])
    checker = CollisionChecker("ur3")
    with pytest.raises(RobotError, match="collides"):
        plan(np.array(get_arm("ur3").home), folded, joint_limits("ur3"), checker.is_clear)


def test_a_goal_that_is_no_number_is_one_line():
    with pytest.raises(RobotError, match="finite"):
        fingers_down(np.array([0.3, np.nan, 0.1]), np.eye(4))
