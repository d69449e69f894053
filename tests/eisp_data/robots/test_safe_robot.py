"""A fault ends in a standstill: stale readings, a lost connection, a held arm, too much torque."""

from dataclasses import replace

import numpy as np
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots.arms import get_arm, joint_limits
from eisp_data.robots.robot import JointCommand, Reading, Robot
from eisp_data.robots.safe_robot import SafeRobot
from eisp_data.robots.safety import SafetyConfig

HOME = np.array(get_arm("ur3").home)


class IdealArm(Robot):
    """Is at once where it is sent, on a clock that ``wait_until`` sets; things can go wrong."""

    name, arm, control_hz = "ideal", "ur3", 25.0
    joint_names = get_arm("ur3").joint_names

    def __init__(self):
        self.limits, self.cameras = joint_limits("ur3"), {}
        self.position, self.opening = HOME.copy(), 0.04
        self.time_s = self.measured_s = 5.0
        self.effort = None
        self.is_held = self.is_lost = False
        self.log = []

    def connect(self):
        self.log.append("connect")

    def calibrate(self):
        self.log.append("calibrate")

    def now_s(self):
        return self.time_s

    def wait_until(self, robot_s):
        self.time_s = self.measured_s = robot_s

    def observe(self):
        self._need_connection()
        zero = np.zeros(6)
        return Reading(self.position.copy(), zero, self.opening, self.measured_s, self.effort)

    def frames(self):
        self._need_connection()
        return {}

    def command(self, command):
        self._need_connection()
        self.log.append("command")
        if not self.is_held:
            self.position = np.array(command.joint_position)
        return command

    def stop(self):
        self.log.append("stop")
        self._need_connection()

    def disconnect(self):
        self.log.append("disconnect")

    def _need_connection(self):
        if self.is_lost:
            raise RobotError("the connection is lost")


@pytest.fixture(scope="module")
def config():
    return SafetyConfig()


@pytest.fixture
def arm():
    return IdealArm()


@pytest.fixture
def safe(arm, config):
    with SafeRobot(arm, config) as robot:
        yield robot


def go(safe, periods=1, stride=0.02):
    sent = None
    for _ in range(periods):
        reading = safe.observe()
        # The last joint turns the tool on the spot: it never meets the end of the workspace.
        wanted = safe.filter.position + stride * np.eye(6)[5]
        sent = safe.command(JointCommand(wanted, 0.04))
        safe.wait_until(reading.hardware_s + 0.04)
    return sent


def assert_stopped(safe, arm):
    assert arm.log[-1] == "stop"
    commands = arm.log.count("command")
    with pytest.raises(RobotError, match="ideal is stopped"):
        safe.command(JointCommand(HOME, 0.04))
    assert arm.log.count("command") == commands, "nothing is sent any more"


def test_a_command_arrives_and_what_was_sent_is_returned(safe, arm):
    go(safe)
    sent = go(safe)
    np.testing.assert_array_equal(arm.position, sent.joint_position)
    assert arm.opening == 0.04
    assert np.abs(arm.position - HOME).max() > 0.01


def test_stale_readings_stop_the_arm(safe, arm):
    go(safe)
    arm.time_s += 0.5
    with pytest.raises(RobotError, match=r"0\.54 s old; the limit is 0\.3 s: ideal is stopped"):
        safe.command(JointCommand(HOME, 0.04))
    assert_stopped(safe, arm)


def test_a_frozen_sensor_is_stale_though_it_answers(safe, arm):
    with pytest.raises(RobotError, match="s old"):
        for _ in range(20):
            safe.observe()
            safe.command(JointCommand(HOME, 0.04))
            arm.time_s += 0.04
    assert_stopped(safe, arm)


def test_a_lost_connection_stops_the_arm(safe, arm):
    go(safe)
    arm.is_lost = True
    with pytest.raises(RobotError, match="the connection is lost: ideal is stopped"):
        safe.observe()
    assert_stopped(safe, arm)


def test_an_arm_that_is_held_is_stopped(safe, arm):
    arm.is_held = True
    with pytest.raises(RobotError, match="rad behind its command"):
        go(safe, periods=60)
    assert_stopped(safe, arm)


def test_too_much_torque_stops_the_arm_and_names_the_joint(safe, arm):
    arm.effort = np.array([0, 0, 27.9, 0, 0, 0])
    with pytest.raises(RobotError, match="the torque of elbow_joint is 100% of its limit"):
        go(safe, periods=10)
    assert_stopped(safe, arm)


@pytest.mark.parametrize("name", ["position", "opening"])
def test_a_reading_that_is_no_number_stops_the_arm(safe, arm, name):
    setattr(arm, name, getattr(arm, name) * np.nan)
    with pytest.raises(RobotError, match="not a number"):
        safe.observe()
    assert_stopped(safe, arm)


def test_connecting_anew_clears_a_fault(safe, arm):
    arm.is_lost = True
    with pytest.raises(RobotError):
        safe.observe()
    arm.is_lost = False
    safe.connect()
    go(safe)
    assert arm.log[-1] == "command"


def test_a_dry_run_filters_but_moves_nothing(arm, config):
    with SafeRobot(arm, config, dry_run=True) as safe:
        safe.calibrate()
        sent = go(safe, periods=5)
    assert np.abs(sent.joint_position - HOME).max() > 0.05
    np.testing.assert_array_equal(arm.position, HOME)
    assert not {"command", "calibrate"} & set(arm.log)


def test_after_a_pause_the_arm_starts_from_rest(safe, arm):
    go(safe, periods=5, stride=0.05)
    before = arm.position
    safe.wait_until(safe.now_s() + 1.0)
    go(safe, stride=0.4)
    most = arm.limits.acceleration / arm.control_hz**2
    assert (np.abs(arm.position - before) <= most + 1e-9).all()


def test_after_a_stop_the_arm_starts_from_where_it_stands(safe, arm):
    go(safe, periods=5, stride=0.05)
    safe.stop()
    arm.position = HOME.copy()
    go(safe)
    assert np.abs(arm.position - HOME).max() < 0.05


def test_nothing_is_commanded_before_connecting_or_after(arm, config):
    safe = SafeRobot(arm, config)
    with pytest.raises(RobotError, match="not connected"):
        safe.command(JointCommand(HOME, 0.04))
    with safe:
        pass
    assert arm.log[-1] == "disconnect"
    with pytest.raises(RobotError, match="not connected"):
        safe.command(JointCommand(HOME, 0.04))


def test_limits_can_be_a_share_of_the_hardwares(arm, config):
    slow = replace(config, velocity_share=0.1, check_collisions=False)
    with SafeRobot(arm, slow) as safe:
        before = arm.position
        go(safe, periods=10, stride=0.2)
        moved = np.abs(arm.position - before)
    assert (moved <= 10 * 0.1 * arm.limits.velocity / arm.control_hz + 1e-9).all()
