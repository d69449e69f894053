"""The UR3 driver and ur_rtde itself against a controller that speaks RTDE on loopback."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots.arms import get_arm
from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.robot import JointCommand
from eisp_data.robots.safe_robot import SafeRobot
from eisp_data.robots.safety import SafetyConfig

pytest.importorskip("rtde_control")
from eisp_data.robots.ur3 import Ur3Robot

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="needs several loopback addresses"
)
HOME = np.array(get_arm("ur3").home)
HOST = f"127.{os.getpid() % 200 + 20}.0.7"
"""ur_rtde knows its ports by heart, so that two tests at once need two addresses."""

POLICY = """
import signal, sys, time
from eisp_data.robots.robot import JointCommand
from eisp_data.robots.ur3 import Ur3Robot

signal.signal(int(sys.argv[2]), signal.SIG_DFL)
with Ur3Robot(sys.argv[1]) as robot:
    here = robot.observe().joint_position
    for number in range(1, 1000):
        robot.command(JointCommand(here + 0.01 * number, 0.04))
        time.sleep(0.04)
        if number == 10:
            print("moving", flush=True)
"""
"""Leads the arm until it is killed."""


class Controller:
    """The stand-in in a process of its own."""

    def __init__(self) -> None:
        script = Path(__file__).with_name("ur_controller.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script), HOST, json.dumps(HOME.tolist())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.process.stdout.readline()

    def ask(self, line: str = "") -> dict:
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def joints(self) -> np.ndarray:
        return np.array(self.ask()["joints"])

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def controller():
    controller = Controller()
    yield controller
    controller.kill()


@pytest.fixture
def ur3(controller):
    with Ur3Robot(HOST) as robot:
        yield robot


def soon(condition):
    until = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def lead(robot, controller, to, periods=10):
    start = robot.observe().joint_position
    due = robot.now_s()
    for i in range(1, periods + 1):
        robot.command(JointCommand(start + i / periods * (to - start), 0.04))
        due += 1 / robot.control_hz
        robot.wait_until(due)


def test_the_arm_goes_where_it_is_led_and_stays_there(ur3, controller):
    target = HOME + 0.1
    lead(ur3, controller, target)
    soon(lambda: np.allclose(ur3.observe().joint_position, target, atol=1e-6))
    soon(lambda: abs(ur3.observe().gripper_opening_m - 0.04) < 0.001)
    np.testing.assert_allclose(controller.joints(), target, atol=1e-6)
    assert 0.0 <= ur3.now_s() - ur3.observe().hardware_s < 1.0


def test_a_policy_behind_the_filter_moves_the_tool_its_way(controller):
    # A machine that runs tests may be slow.
    patient = SafetyConfig(stale_s=5.0, following_rad=3.0)
    with SafeRobot(Ur3Robot(HOST), patient) as robot:
        servo = CartesianServo(robot.arm, robot.control_hz)
        sent = robot.observe().joint_position
        start = servo.tool_in_task(sent)
        for _ in range(15):
            due_s = robot.now_s() + 1 / robot.control_hz
            robot.observe()
            sent = robot.command(servo.step(np.array([0.1, 0.1, 0.0, 1.0]), sent)).joint_position
            robot.wait_until(due_s)
        soon(lambda: np.allclose(controller.joints(), sent, atol=1e-6))
    moved = servo.tool_in_task(sent) - start
    np.testing.assert_allclose(moved, [0.06, 0.06, 0.0], atol=0.01)


def test_what_was_really_sent_to_the_gripper_is_one_of_its_steps(ur3):
    sent = ur3.command(JointCommand(HOME, 0.0401)).gripper_opening_m
    assert 0.0 < abs(sent - 0.0401) < 0.085 / 200


def test_stop_ends_the_servo_mode_and_a_new_command_begins_it_again(ur3, controller):
    lead(ur3, controller, HOME + 0.05)
    ur3.stop()
    soon(lambda: 16 in controller.ask()["commands"])  # servoStop
    lead(ur3, controller, HOME)
    soon(lambda: np.allclose(controller.joints(), HOME, atol=1e-6))


def test_calibration_activates_the_gripper_and_finds_the_ends_of_its_range(controller):
    controller.ask("power_up_gripper")
    with SafeRobot(Ur3Robot(HOST)) as robot:
        robot.calibrate()
        lines = controller.ask()["lines"]
        assert {"SET ACT 1", "SET POS 0 SPE 255 FOR 60 GTO 1"} <= set(lines)
        reading = robot.observe()
        assert reading.gripper_opening_m == pytest.approx(0.085)
        robot.command(JointCommand(reading.joint_position, 0.085))


def test_a_dry_run_leaves_the_gripper_as_it_is(controller):
    controller.ask("power_up_gripper")
    with SafeRobot(Ur3Robot(HOST), dry_run=True) as robot:
        robot.calibrate()
        robot.command(JointCommand(robot.observe().joint_position, 0.0))
    said = {line for line in controller.ask()["lines"] if not line.startswith("GET")}
    assert said <= {"SET GTO 0"}, "stand still is all that it was told"


def test_without_an_active_gripper_nothing_moves(controller):
    controller.ask("power_up_gripper")
    with Ur3Robot(HOST) as robot:
        with pytest.raises(RobotError, match="the gripper is not active") as caught:
            robot.command(JointCommand(HOME + 0.1, 0.04))
        assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(controller.joints(), HOME)


def test_a_connection_lost_in_mid_motion_is_an_error_and_ends_in_time(ur3, controller):
    lead(ur3, controller, HOME + 0.1, periods=3)
    controller.kill()
    with pytest.raises(RobotError, match=r"the connection to the UR controller at .* is lost"):
        for _ in range(100):
            ur3.command(JointCommand(HOME, 0.04))
            time.sleep(0.02)
    before = time.monotonic()
    ur3.disconnect()
    assert time.monotonic() - before < 10.0, "ur_rtde alone waits for ever"


def test_a_link_that_falls_silent_lets_the_controller_stop_the_arm(ur3, controller):
    far = HOME + 5.0
    for _ in range(3):
        ur3.command(JointCommand(far, 0.04))
    ur3._link._process.send_signal(signal.SIGSTOP)
    time.sleep(1.0)
    standing = controller.joints()
    time.sleep(0.3)
    np.testing.assert_array_equal(controller.joints(), standing)
    with pytest.raises(RobotError, match="is lost"):
        ur3.observe()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_the_arm_is_stopped_when_a_terminal_kills_who_leads_it(controller, number):
    policy = subprocess.Popen(
        [sys.executable, "-c", POLICY, HOST, str(int(number))],
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    assert policy.stdout.readline()
    os.killpg(policy.pid, number)
    policy.communicate()
    soon(lambda: {16, 255} <= set(controller.ask()["commands"]))  # servoStop, stopScript
    standing = controller.joints()
    assert np.abs(standing - HOME).max() > 0.0
    time.sleep(0.3)
    np.testing.assert_array_equal(controller.joints(), standing)


def test_a_protective_stop_is_named(ur3, controller):
    controller.ask("protective_stop")
    with pytest.raises(RobotError, match="protective stop"):
        soon(lambda: ur3.command(JointCommand(HOME, 0.04)) is None)


def test_nobody_at_the_address_is_one_line():
    with pytest.raises(RobotError, match=r"no gripper at 127\.0\.0\.1:63352: ") as caught:
        Ur3Robot("127.0.0.1").connect()
    assert "\n" not in str(caught.value)


def test_a_camera_that_is_not_there_is_one_line_and_nothing_stays_connected(controller):
    robot = Ur3Robot(HOST, camera="/no/such/camera")
    with pytest.raises(RobotError, match="camera '/no/such/camera' gives no image"):
        robot.connect()
    assert controller.ask()["commands"] == []
