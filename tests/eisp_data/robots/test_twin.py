"""The twin is the tasks' own table before a UR3, and behaves as a robot with a camera does."""

from __future__ import annotations

import threading

import mujoco
import numpy as np
import pytest

from eisp_data.errors import ConfigError, RobotError
from eisp_data.robots import cell
from eisp_data.robots.aruco import MarkerDetector
from eisp_data.robots.kinematics import kinematics
from eisp_data.robots.markers import marked_objects
from eisp_data.robots.pose import View
from eisp_data.robots.registry import make_robot
from eisp_data.robots.robot import JointCommand
from eisp_data.robots.twin.camera import CAMERA, CameraOptions
from eisp_data.robots.twin.robot import TwinRobot
from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from eisp_data.tasks.registry import TASKS, get_task

TICK_S = 0.04


def swing(robot: TwinRobot, ticks: int, amplitude_rad: float = 0.1) -> None:
    """Turn the base to and fro, one period a second."""
    start = np.array(cell.HOME_RAD)
    for tick in range(1, ticks + 1):
        deadline = robot.now_s() + TICK_S
        target = start + amplitude_rad * np.sin(2 * np.pi * tick * TICK_S) * np.eye(6)[0]
        robot.command(JointCommand(target, 0.08))
        robot.wait_until(deadline)


@pytest.mark.parametrize("name", TASKS)
def test_what_stands_on_the_table_is_what_stands_in_the_tasks_scene(name):
    task, robot = get_task(name), TwinRobot(name)
    own, its = task.model, robot.referee._world.model
    compared = 0
    for body in range(1, own.nbody):
        label = own.body(body).name
        if label.startswith(("block", "drawer")):
            assert its.body(label).mass == own.body(label).mass
    for geom in range(own.ngeom):
        label = own.geom(geom).name
        held = label in ("left_pad", "right_pad", "palm")
        if label:
            twin = its.geom(f"hand/{label}" if held else label)
            for field in ("size", "friction", "solref", "priority", "condim"):
                np.testing.assert_array_equal(
                    getattr(twin, field), getattr(own.geom(geom), field), err_msg=label
                )
            compared += 1
    assert compared >= 4 + task.blocks
    assert its.opt.cone == own.opt.cone and its.opt.impratio == own.opt.impratio


@pytest.mark.parametrize("name", TASKS)
def test_a_reset_sets_the_table_as_the_task_does(name):
    robot, task = TwinRobot(name), get_task(name)
    state, goal = task.reset(np.random.default_rng(7))
    np.testing.assert_array_equal(robot.referee.reset(7), goal)
    there = robot.referee.state()
    count = 3 if task.fingers_closed else 5
    np.testing.assert_allclose(task.qpos(there)[5:], task.qpos(state)[5:], atol=1e-12)
    np.testing.assert_allclose(task.qpos(there)[3:count], task.qpos(state)[3:count], atol=1e-12)
    assert robot.referee.settled() and not robot.referee.success(goal)
    np.testing.assert_allclose(robot.referee.achieved_goal(), task.achieved_goal(state[None])[0])


def test_the_arms_kinematics_are_those_of_the_model():
    with TwinRobot() as robot:
        swing(robot, 8)
        tool = kinematics("ur3").forward(robot.observe().joint_position)
        truth = cell.transform_task_to_base() @ robot.referee.object_pose("gripper")
        np.testing.assert_allclose(tool, truth, atol=1e-6)


def test_home_is_over_the_middle_of_the_workspace_with_the_fingers_down():
    tool = cell.inverse(cell.transform_task_to_base()) @ kinematics("ur3").forward(
        np.array(cell.HOME_RAD)
    )
    np.testing.assert_allclose(tool[:3, :3], np.eye(3), atol=0.002)
    assert (tool[:3, 3] > WORKSPACE_LOW_M).all() and (tool[:3, 3] < WORKSPACE_HIGH_M).all()


def test_joints_follow_their_targets_closely_and_hold_against_gravity():
    with TwinRobot() as robot:
        swing(robot, 7)  # where the base is fastest but one
        target = cell.HOME_RAD[0] + 0.1 * np.sin(2 * np.pi * 7 * TICK_S)
        assert abs(robot.observe().joint_position[0] - target) < 0.005
        for _ in range(2):  # one period is too short for the way back
            robot.command(JointCommand(np.array(cell.HOME_RAD), 0.08))
            robot.wait_until(robot.now_s() + 0.5)
        rest = robot.observe()
        np.testing.assert_allclose(rest.joint_position, cell.HOME_RAD, atol=1e-3)
        np.testing.assert_allclose(rest.joint_velocity, 0.0, atol=1e-3)


def test_nothing_moves_and_no_time_passes_but_by_waiting():
    with TwinRobot() as robot:
        before = robot.observe()
        robot.command(JointCommand(np.array(cell.HOME_RAD) + 0.05, 0.0))
        after = robot.observe()
        assert robot.now_s() == before.hardware_s == after.hardware_s
        np.testing.assert_array_equal(before.joint_position, after.joint_position)
        robot.wait_until(0.04)
        assert robot.observe().joint_position[0] > before.joint_position[0] + 0.03


def test_the_same_seed_and_commands_give_the_same_motion_and_images():
    seen = []
    for _ in range(2):
        with TwinRobot(seed=3) as robot:
            swing(robot, 4)
            image = robot.frames()[CAMERA].image
            seen.append((robot.referee.state(), image))
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


def test_a_target_too_far_is_approached_at_the_joints_own_speed():
    with TwinRobot() as robot:
        sent = robot.command(JointCommand(np.array(cell.HOME_RAD) + 2.0, 1.0))
        moved = sent.joint_position - cell.HOME_RAD
        np.testing.assert_allclose(moved, robot.limits.velocity * TICK_S)
        assert sent.gripper_opening_m == robot.limits.gripper_m[1]


@pytest.mark.parametrize(
    ("position", "opening", "said"),
    [
        ([np.nan] * 6, 0.0, "takes 6 finite joint angles"),
        ([0.0] * 5, 0.0, "takes 6 finite joint angles"),
        (cell.HOME_RAD, np.inf, "a finite opening; got inf"),
    ],
)
def test_what_is_no_command_is_refused_in_one_line(position, opening, said):
    with TwinRobot() as robot, pytest.raises(RobotError, match=said):
        robot.command(JointCommand(np.array(position), opening))


def test_a_stop_from_another_thread_brings_the_arm_to_rest_for_good():
    with TwinRobot() as robot:
        swing(robot, 5)
        robot.command(JointCommand(robot.observe().joint_position + 0.08, 0.08))
        robot.wait_until(robot.now_s() + 0.02)
        thread = threading.Thread(target=robot.stop)
        thread.start()
        thread.join()
        robot.wait_until(robot.now_s() + 0.4)
        stopped = robot.observe()
        robot.wait_until(robot.now_s() + 0.2)
        np.testing.assert_allclose(stopped.joint_velocity, 0.0, atol=5e-3)
        np.testing.assert_allclose(
            robot.observe().joint_position, stopped.joint_position, atol=1e-3
        )


@pytest.mark.parametrize("latency_s", [0.1, 0.9])
def test_an_image_comes_late_by_its_latency_and_keeps_its_time(latency_s):
    with TwinRobot(camera=CameraOptions(latency_s=latency_s)) as robot:
        robot.wait_until(latency_s - 0.01)
        assert robot.frames() == {}
        robot.wait_until(latency_s + 0.15)
        frame = robot.frames()[CAMERA]
        assert frame.sequence == 4 and frame.captured_s == pytest.approx(4 / 30, abs=0.002)
        assert frame.image.shape == (480, 640, 3) and frame.image.dtype == np.uint8


def test_lost_images_leave_gaps_in_the_sequence():
    with TwinRobot(camera=CameraOptions(drop_probability=0.5, latency_s=0.0)) as robot:
        robot.wait_until(0.2)
        kept = [moment.sequence for moment in robot.referee._world.snapshots]
    assert 0 < len(kept) < 6 and kept == sorted(set(kept))


def test_noise_is_as_strong_as_asked_for_and_differs_from_image_to_image():
    with TwinRobot(camera=CameraOptions(noise_std=4.0, latency_s=0.0)) as robot:
        images = []
        for time_s in (0.05, 0.1):
            robot.wait_until(time_s)
            images.append(robot.frames()[CAMERA].image.astype(float))
    # A patch of table on which nothing moves.
    difference = (images[1] - images[0])[300:340, 300:340]
    assert difference.std() == pytest.approx(4.0 * 2**0.5, rel=0.1)


@pytest.mark.parametrize("name", ["stack", "store"])
def test_markers_are_in_the_image_where_the_lens_has_them(name):
    with TwinRobot(name, seed=2, camera=CameraOptions(mounting_error=1.0)) as robot:
        robot.wait_until(0.1)
        found = MarkerDetector().detect(robot.frames()[CAMERA].image)
        referee = robot.referee
        off = []
        for item in marked_objects(robot.task).values():
            pose = referee.object_pose(item.name)
            for marker in item.markers:
                [seen] = np.nonzero(found.numbers == marker.number)
                if len(seen):
                    corners = cell.apply(pose, marker.corners())
                    off.append(project(referee, corners) - found.corners[seen[0]])
        distance = np.linalg.norm(np.concatenate(off), axis=1)
        assert len(off) >= 9
        assert np.median(distance) < 0.15 and np.percentile(distance, 90) < 0.5


def project(referee, points: np.ndarray) -> np.ndarray:
    import cv2

    lens = referee.camera.intrinsics
    there = cell.apply(cell.inverse(referee.camera.transform_camera_to_task), points)
    zero = np.zeros(3)
    return cv2.projectPoints(there, zero, zero, lens.matrix, lens.distortion)[0][:, 0]


def test_the_design_is_right_only_without_a_mounting_error():
    exact, off = TwinRobot(), TwinRobot(camera=CameraOptions(mounting_error=1.0))
    for robot, right in ((exact, True), (off, False)):
        view = View(robot.calibration.cameras[CAMERA], robot.calibration.transform_base_to_task)
        point = np.array([[0.3, 0.1, 0.0]])
        close = np.linalg.norm(view.project(point) - project(robot.referee, point)) < 0.01
        assert close == right


def test_an_unplugged_camera_and_a_lost_arm_are_one_line_each():
    with TwinRobot() as robot:
        robot.referee.unplugged_camera = robot.referee.unplugged_arm = True
        with pytest.raises(RobotError, match="camera 'top' of the twin is unplugged"):
            robot.frames()
        with pytest.raises(RobotError, match="the connection to the twin's arm is lost"):
            robot.observe()
    with pytest.raises(RobotError, match="not connected"):
        robot.observe()


def test_on_the_walls_time_images_keep_coming_and_the_clock_runs_by_itself():
    with TwinRobot(realtime=True) as robot:
        start = robot.now_s()
        robot.wait_until(start + 0.1)
        assert robot.now_s() >= start + 0.1
        frame = None
        while robot.now_s() < start + 120 and (frame is None or frame.sequence < 2):
            robot.wait_until(robot.now_s() + 0.02)
            frame = robot.frames().get(CAMERA)
        assert frame is not None and frame.captured_s <= robot.now_s()
        # Up to a step of the simulation; how far behind depends on the machine's load.
        assert start < robot.observe().hardware_s <= robot.now_s() + 0.01


def test_an_external_hand_moves_a_block():
    robot = TwinRobot()
    robot.referee.move_block(1, np.array([0.3, 0.1, 0.025]), yaw=0.5)
    pose = robot.referee.object_pose("block1")
    np.testing.assert_allclose(pose[:3, 3], [0.3, 0.1, 0.025])
    assert np.arctan2(pose[1, 0], pose[0, 0]) == pytest.approx(0.5)
    np.testing.assert_allclose(robot.referee.achieved_goal()[3:6], [0.3, 0.1, 0.025])


def test_the_registry_makes_it_and_names_what_is_wrong():
    assert isinstance(make_robot("twin", task="store"), TwinRobot)
    with pytest.raises(ConfigError, match="unknown task 'tidy'"):
        make_robot("twin", task="tidy")
    with pytest.raises(ConfigError, match="drop probability must be 0 to 1; got 2"):
        make_robot("twin", camera=CameraOptions(drop_probability=2))


def test_the_arm_cannot_pass_through_the_table():
    with TwinRobot() as robot:
        arm, placed = kinematics("ur3"), cell.transform_task_to_base()
        below = cell.transform(np.eye(3), np.array([0.31, 0.0, -0.05]))
        target = arm.inverse(placed @ below, np.array(cell.HOME_RAD))
        for _ in range(40):
            robot.command(JointCommand(target, 0.08))
            robot.wait_until(robot.now_s() + TICK_S)
        data = robot.referee._world.data
        assert robot.referee.object_pose("gripper")[2, 3] > 0.0
        assert min((c.dist for c in data.contact[: data.ncon]), default=0.0) > -0.005
        assert (
            not np.isnan(data.qpos).any()
            and data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 0
        )
