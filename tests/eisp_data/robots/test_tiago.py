"""The TIAGo++ driver against a server that speaks rosbridge on loopback."""

import time

import numpy as np
import pytest

from eisp_data.errors import ConfigError, RobotError
from eisp_data.robots.arms import get_arm
from eisp_data.robots.robot import JointCommand

pytest.importorskip("websockets")
from rosbridge_server import RosbridgeServer

from eisp_data.robots.tiago import TiagoRobot

ARM = get_arm("tiago_left")
FINGERS = ("gripper_left_left_finger_joint", "gripper_left_right_finger_joint")
JOINTS = dict(zip(ARM.joint_names, ARM.home, strict=True)) | dict.fromkeys(FINGERS, 0.02)
CAMERA = "/top/image_raw/compressed"


@pytest.fixture
def server():
    server = RosbridgeServer({"head_1_joint": 0.3} | JOINTS)
    yield server
    server.close()


@pytest.fixture
def tiago(server):
    with TiagoRobot(server.host, camera=CAMERA) as robot:
        yield robot


def soon(condition):
    until = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def test_a_reading_has_the_joints_of_the_arm_and_no_others(tiago):
    reading = tiago.observe()
    np.testing.assert_allclose(reading.joint_position, ARM.home)
    np.testing.assert_allclose(reading.joint_effort, 0.5)
    assert reading.gripper_opening_m == pytest.approx(0.04)


def test_the_robots_stamps_are_put_on_this_machines_clock(tiago):
    for _ in range(20):
        reading = tiago.observe()
        time.sleep(0.02)
    assert -1e-9 <= tiago.now_s() - reading.hardware_s < 1.0


def test_a_command_becomes_one_point_one_control_period_away(tiago, server):
    target = np.array(ARM.home) + 0.01
    tiago.command(JointCommand(target, 0.06))
    soon(lambda: len(server.received) == 2)
    sent = server.received["/arm_left_controller/command"][0]
    assert sent["joint_names"] == list(ARM.joint_names)
    assert sent["points"][0]["time_from_start"] == {"secs": 0, "nsecs": 40_000_000}
    soon(lambda: np.allclose(tiago.observe().joint_position, target))
    soon(lambda: abs(tiago.observe().gripper_opening_m - 0.06) < 1e-9)


def test_what_is_published_was_announced_with_its_type(tiago, server):
    tiago.command(JointCommand(np.array(ARM.home), 0.0))
    soon(lambda: len(server.received) == 2)
    assert server.advertised == dict.fromkeys(server.received, "trajectory_msgs/JointTrajectory")


def test_stop_sends_the_empty_trajectory_that_makes_the_controller_hold(tiago, server):
    tiago.stop()
    soon(lambda: len(server.received) == 2)
    assert not server.received["/arm_left_controller/command"][-1].get("points")


def test_images_come_with_the_lens_that_the_camera_says_it_has(tiago):
    frame = tiago.frames()["top"]
    assert frame.image.shape == (48, 64, 3)
    assert frame.image[0, 0].tolist() == [200, 0, 0], "RGB"
    assert tiago.cameras["top"].matrix[0, 0] == 60.0
    assert tiago.cameras["top"].distortion[0] == 0.1
    soon(lambda: tiago.frames()["top"].sequence > frame.sequence)


def test_an_unplugged_camera_is_one_line(tiago, server):
    server.camera_is_plugged = False
    time.sleep(1.2)
    with pytest.raises(RobotError, match=r"camera 'top' .* is unplugged"):
        tiago.frames()


def test_a_lost_connection_is_an_error_and_not_an_old_reading(tiago, server):
    server.close()
    with pytest.raises(RobotError, match="is lost"):
        soon(lambda: tiago.observe() is None)
    tiago.disconnect()


def test_nobody_at_the_address_is_one_line():
    with pytest.raises(RobotError, match=r"no rosbridge at 127\.0\.0\.1:9: ") as caught:
        TiagoRobot("127.0.0.1:9").connect()
    assert "\n" not in str(caught.value)


def test_another_robot_is_not_taken_for_a_tiago():
    server = RosbridgeServer({"joint_a": 0.0})
    with pytest.raises(RobotError, match="has no arm_left_1_joint: this is another robot"):
        TiagoRobot(server.host).connect()
    server.close()


def test_there_are_two_sides():
    with pytest.raises(ConfigError, match=r"'middle'.*left or right"):
        TiagoRobot("127.0.0.1", side="middle")
