"""Forward and inverse kinematics of every arm, against Pinocchio and against themselves."""

import numpy as np
import pinocchio as pin
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots.arms import ARMS, arm_model, get_arm, joint_limits
from eisp_data.robots.collision import CollisionChecker
from eisp_data.robots.kinematics import Kinematics
from eisp_data.robots.motion import fingers_down
from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M

POSES = 300


@pytest.fixture(scope="module", params=ARMS)
def kinematics(request):
    return Kinematics(request.param)


def postures(kinematics, count, seed=0):
    return kinematics.random_postures(np.random.default_rng(seed), count)


def pose_error(one, other):
    turned = pin.log3(one[:3, :3].T @ other[:3, :3])
    return np.linalg.norm(one[:3, 3] - other[:3, 3]), np.linalg.norm(turned)


def test_random_reachable_poses_are_solved_to_a_tenth_of_a_millimetre(kinematics):
    for posture in postures(kinematics, POSES):
        wanted = kinematics.forward(posture)
        found = kinematics.inverse(wanted)
        apart, turned = pose_error(kinematics.forward(found), wanted)
        assert apart < 1e-4 and turned < 1e-4
        assert (found >= kinematics.low).all() and (found <= kinematics.high).all()


def test_the_jacobian_is_the_derivative_of_the_pose(kinematics):
    step = 1e-6
    for posture in postures(kinematics, 5, seed=1):
        jacobian = kinematics.jacobian(posture)
        here = kinematics.forward(posture)
        for joint in range(len(posture)):
            moved = kinematics.forward(posture + step * np.eye(len(posture))[joint])
            linear = (moved[:3, 3] - here[:3, 3]) / step
            angular = pin.log3(moved[:3, :3] @ here[:3, :3].T) / step
            np.testing.assert_allclose(jacobian[:, joint], [*linear, *angular], atol=1e-5)


def test_the_fingers_point_down_anywhere_in_the_workspace_without_a_collision(kinematics):
    arm = get_arm(kinematics.arm)
    clear = CollisionChecker(kinematics.arm).is_clear
    grid = np.linspace(WORKSPACE_LOW_M, WORKSPACE_HIGH_M, 4)
    for x in grid[:, 0]:
        for y in grid[:, 1]:
            for z in grid[:, 2]:
                pose = fingers_down(np.array([x, y, z]), arm.transform_task_to_base)
                found = kinematics.inverse(pose, kinematics.home, clear)
                np.testing.assert_allclose(kinematics.forward(found), pose, atol=1e-4)


def test_a_solution_stays_near_the_posture_it_starts_from(kinematics):
    for posture in postures(kinematics, 50, seed=2):
        if np.linalg.svd(kinematics.jacobian(posture), compute_uv=False)[-1] < 0.05:
            continue  # next to a singularity
        pose = kinematics.forward(posture)
        pose[:3, 3] += 0.005
        try:
            found = kinematics.inverse(pose, near=posture)
        except RobotError:
            continue
        assert np.abs(found - posture).max() < 0.5


def test_tracking_out_of_reach_goes_as_far_as_the_arm_can_and_keeps_its_limits(kinematics):
    arm = get_arm(kinematics.arm)
    posture = kinematics.home
    start = kinematics.forward(posture)
    for step in range(60):
        pose = start.copy()
        pose[0, 3] += 0.02 * step
        posture = kinematics.track(pose, posture)
        assert np.isfinite(posture).all()
        assert (posture >= kinematics.low).all() and (posture <= kinematics.high).all()
    assert kinematics.forward(posture)[0, 3] > start[0, 3] + 0.05
    assert arm.name == kinematics.arm


def test_an_unreachable_goal_is_one_line_with_the_place(kinematics):
    pose = np.eye(4)
    pose[:3, 3] = (3.0, 0.0, 0.5)
    with pytest.raises(RobotError, match=r"unreachable goal: .* at \(3\.000, 0\.000, 0\.500\) m"):
        kinematics.inverse(pose)


def test_joints_come_in_the_order_of_their_names(kinematics):
    model = arm_model(kinematics.arm)
    assert tuple(model.names[1:]) == get_arm(kinematics.arm).joint_names
    limits = joint_limits(kinematics.arm)
    assert (limits.velocity > 0).all() and (limits.effort > 0).all()


@pytest.mark.parametrize("arm", ARMS)
def test_home_is_clear_and_an_arm_in_the_table_is_not(arm):
    checker, kinematics = CollisionChecker(arm), Kinematics(arm)
    assert checker.is_clear(kinematics.home)
    assert not checker.meets(kinematics.home)
    under = fingers_down(np.array([0.3, 0.0, -0.08]), get_arm(arm).transform_task_to_base)
    inside = kinematics.inverse(under, kinematics.home)
    assert not checker.is_clear(inside)
    assert any("table" in pair for pair in checker.meets(inside))


def test_a_gripper_that_reaches_back_meets_the_pedestal_and_nothing_else():
    reaching = np.array([1.09, -0.46, 2.14, -1.76, -1.50, 2.29])
    assert CollisionChecker("ur3").meets(reaching) == [("gripper", "pedestal")]


def test_an_arm_folded_into_itself_collides():
    folded = np.array([0.0, -1.5, 2.9, -1.0, 0.0, 0.0])
    meets = CollisionChecker("ur3").meets(folded)
    assert meets and not any("table" in pair for pair in meets)
