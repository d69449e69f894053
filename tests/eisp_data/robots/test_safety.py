"""No command leaves the limits, whatever the policy puts out.

``EISP_SAFETY_OUTPUTS`` is how many adversarial outputs each arm gets; a million takes minutes.
"""

import os
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from eisp_data.errors import ConfigError
from eisp_data.robots.arms import ARMS, arm_model, get_arm, joint_limits
from eisp_data.robots.collision import CollisionChecker
from eisp_data.robots.kinematics import Kinematics
from eisp_data.robots.motion import CartesianServo, fingers_down
from eisp_data.robots.robot import JointCommand
from eisp_data.robots.safety import SafetyConfig, SafetyFilter

OUTPUTS = int(os.environ.get("EISP_SAFETY_OUTPUTS", "1500"))
HZ = 25.0
ROUND = 250
"""The arm starts anew after so many outputs."""
SLACK = 1e-6
CONFIG = SafetyConfig()
NASTY = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 5.0, 0.0])


def make_filter(arm: str, config: SafetyConfig = CONFIG) -> SafetyFilter:
    return SafetyFilter(arm, joint_limits(arm), HZ, config, collisions=CollisionChecker(arm))


def postures(arm: str, count: int, rng) -> np.ndarray:
    """Postures with the fingers down, anywhere in the workspace, at which the arm may stand."""
    kinematics, allows = Kinematics(arm), make_filter(arm).allows
    placed = get_arm(arm).transform_task_to_base
    points = rng.uniform((0.20, -0.18, 0.03), (0.42, 0.18, 0.28), (count, 3))
    poses = [fingers_down(point, placed) for point in points]
    return np.stack([kinematics.inverse(pose, kinematics.home, allows) for pose in poses])


def outputs(rng, count: int) -> np.ndarray:
    """Policy outputs (count, 4) of one temper: a walk, bang-bang, a push, noise, or garbage."""
    temper = rng.integers(5)
    if temper == 0:
        return np.cumsum(rng.normal(0, 0.3, (count, 4)), axis=0)
    if temper == 1:
        return np.repeat(rng.choice([-1.0, 1.0], (-(-count // 7), 4)), 7, axis=0)[:count]
    if temper == 2:
        return np.broadcast_to(rng.normal(size=4) * 10.0, (count, 4)).copy()
    actions = rng.uniform(-1.5, 1.5, (count, 4))
    if temper == 3:
        wild = rng.random((count, 4)) < 0.2
        actions[wild] = rng.choice(NASTY, wild.sum())
    return actions


def drive(arm: str, total: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Send outputs through servo and filter; return targets (R, ROUND + 1, J) and openings."""
    rng = np.random.default_rng(seed)
    guard, servo = make_filter(arm), CartesianServo(arm, HZ)
    starts = postures(arm, 10, rng)
    rounds = -(-total // ROUND)
    targets = np.empty((rounds, ROUND + 1, starts.shape[1]))
    openings = np.empty((rounds, ROUND + 1))
    for i in range(rounds):
        targets[i, 0], openings[i, 0] = starts[i % len(starts)], 0.04
        guard.start(targets[i, 0], openings[i, 0])
        servo.start()
        for k, action in enumerate(outputs(rng, ROUND), 1):
            wanted = servo.step(action, guard.position)
            if i % 3 == 2:
                # A policy over joints instead: near or anywhere, and sometimes no number at all.
                near = guard.position + rng.normal(0, 0.1, starts.shape[1])
                anywhere = rng.uniform(-7, 7, starts.shape[1])
                joints = (near, anywhere, np.full(starts.shape[1], rng.choice(NASTY)))
                wanted = JointCommand(joints[rng.choice(3, p=(0.8, 0.1, 0.1))], action[3])
            sent = guard.step(wanted)
            targets[i, k], openings[i, k] = sent.joint_position, sent.gripper_opening_m
    return targets, openings


@pytest.fixture(scope="module", params=ARMS)
def driven(request):
    return request.param, *drive(request.param, OUTPUTS, seed=1)


def test_every_joint_keeps_its_range_speed_and_acceleration(driven):
    arm, targets, _ = driven
    limits = joint_limits(arm)
    assert (targets >= limits.position_low - SLACK).all()
    assert (targets <= limits.position_high + SLACK).all()
    speed = np.diff(targets, axis=1, prepend=targets[:, :1]) * HZ
    assert (np.abs(speed) <= CONFIG.velocity_share * limits.velocity + SLACK).all()
    change = np.diff(speed, axis=1, append=speed[:, -1:]) * HZ
    assert (np.abs(change) <= limits.acceleration + SLACK * HZ).all()


def test_the_tool_keeps_to_its_workspace_and_speed(driven):
    arm, targets, _ = driven
    servo = CartesianServo(arm, HZ)
    places = np.array([[servo.tool_in_task(joints) for joints in row] for row in targets])
    assert (places >= np.array(CONFIG.workspace_low_m) - SLACK).all()
    assert (places <= np.array(CONFIG.workspace_high_m) + SLACK).all()
    speed = np.linalg.norm(np.diff(places, axis=1), axis=2) * HZ
    assert (speed <= CONFIG.tool_speed_m_s + 1e-4).all()
    assert speed.max() > 0.5 * CONFIG.tool_speed_m_s, "an arm that never moves is no test"


def test_no_posture_collides_and_no_torque_is_too_high(driven):
    arm, targets, _ = driven
    model, checker = arm_model(arm), CollisionChecker(arm, clearance_m=0.0)
    data, limits = model.createData(), joint_limits(arm)
    assert all(checker.is_clear(joints) for row in targets for joints in row)
    speed = np.diff(targets, axis=1, prepend=targets[:, :1]) * HZ
    change = np.diff(speed, axis=1) * HZ
    torques = np.array(
        [
            pin.rnea(model, data, joints, speed[i, k + 1], change[i, k])
            for i, row in enumerate(targets)
            for k, joints in enumerate(row[:-1])
        ]
    )
    assert (np.abs(torques) <= CONFIG.effort_share * limits.effort + SLACK).all()


def wander(guard, steps: int, seed: int = 5) -> np.ndarray:
    """Push joints about at random, a second each way; return the targets (steps + 1, J)."""
    rng = np.random.default_rng(seed)
    rows = [guard.position]
    for step in range(steps):
        if step % 25 == 0:
            push = rng.normal(0, 0.1, len(guard.position))
        rows.append(guard.step(JointCommand(guard.position + push, 0.04)).joint_position)
    return np.stack(rows)


def test_a_low_limit_of_torque_holds_where_it_bites():
    share = 0.25
    rows = []
    for one in (share, 0.9):
        guard = make_filter("ur3", replace(CONFIG, effort_share=one))
        guard.start(postures("ur3", 1, np.random.default_rng(3))[0], 0.04)
        rows.append(wander(guard, 300))
    model = arm_model("ur3")
    data, bound = model.createData(), share * joint_limits("ur3").effort
    highest = []
    for targets in rows:
        speed = np.diff(targets, axis=0, prepend=targets[:1]) * HZ
        change = np.diff(speed, axis=0) * HZ
        torques = [
            pin.rnea(model, data, *row) for row in zip(targets, speed[1:], change, strict=False)
        ]
        highest.append((np.abs(torques) / bound).max())
    kept, free = highest
    assert kept <= 1.0 + SLACK < free


@pytest.mark.parametrize("arm", ["ur3", "tiago_left"])
def test_an_arm_with_room_to_collide_does_not(arm):
    room = replace(CONFIG, workspace_low_m=(-2.0,) * 3, workspace_high_m=(2.0,) * 3)
    limits, checker = joint_limits(arm), CollisionChecker(arm, clearance_m=0.0)
    collided = []
    for collisions in (CollisionChecker(arm), None):
        guard = SafetyFilter(arm, limits, HZ, room, collisions=collisions)
        guard.start(np.array(get_arm(arm).home), 0.04)
        collided.append(not all(map(checker.is_clear, wander(guard, 500))))
    assert collided == [False, True], "with and without the check"


def test_the_gripper_keeps_its_range_and_speed(driven):
    arm, _, openings = driven
    limits = joint_limits(arm)
    low, high = limits.gripper_m
    assert (openings >= low).all() and (openings <= high).all()
    assert (np.abs(np.diff(openings, axis=1)) * HZ <= limits.gripper_speed_m_s + SLACK).all()


@pytest.fixture
def guard():
    guard = make_filter("ur3")
    guard.start(postures("ur3", 1, np.random.default_rng(3))[0], 0.04)
    return guard


def test_what_is_allowed_goes_through_unchanged(guard):
    for _ in range(5):
        wanted = guard.position + 0.005
        np.testing.assert_allclose(guard.step(JointCommand(wanted, 0.04)).joint_position, wanted)
    assert not guard.refusals


@pytest.mark.parametrize("bad", [np.full(6, np.nan), np.full(6, np.inf), np.zeros(7), np.zeros(0)])
def test_targets_that_are_no_targets_bring_the_arm_to_rest(guard, bad):
    for _ in range(5):
        guard.step(JointCommand(guard.position + 0.05, 0.04))
    before = guard.position
    for _ in range(20):
        guard.step(JointCommand(bad, 0.04))
    assert guard.stopped
    assert guard.refusals["not finite"] == 20
    assert np.abs(guard.position - before).max() < 0.5


def test_a_jump_is_refused_and_counted(guard):
    before = guard.position
    sent = guard.step(JointCommand(before + 1.0, 0.04))
    np.testing.assert_array_equal(sent.joint_position, before)
    assert guard.refusals["jump"] == 1


def test_a_gripper_target_that_is_no_number_leaves_the_gripper_as_it_is(guard):
    assert guard.step(JointCommand(guard.position, float("nan"))).gripper_opening_m == 0.04


def test_an_arm_that_starts_outside_may_come_in_but_not_go_further_out():
    guard, servo = make_filter("ur3"), CartesianServo("ur3", HZ)
    kinematics, placed = Kinematics("ur3"), get_arm("ur3").transform_task_to_base
    outside = kinematics.inverse(fingers_down(np.array([0.3, 0.26, 0.15]), placed), kinematics.home)
    guard.start(outside, 0.04)
    for direction, comes_in in ((1.0, False), (-1.0, True)):
        guard.start(outside, 0.04)
        servo.start()
        for _ in range(25):
            guard.step(servo.step(np.array([0.0, direction, 0.0, 1.0]), guard.position))
        y = servo.tool_in_task(guard.position)[1]
        assert y <= 0.26 + SLACK
        assert (y < 0.2) == comes_in


def test_there_are_only_the_arms_that_there_are():
    with pytest.raises(ConfigError, match="unknown arm 'ur9'; choose one of ur3, tiago_left"):
        get_arm("ur9")
