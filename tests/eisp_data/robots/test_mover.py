"""An arm that meets something presses gently, and stays where it is."""

import numpy as np
import pytest

pytest.importorskip("pinocchio")

from eisp_data.robots.motion import CartesianServo
from eisp_data.robots.mover import Mover
from eisp_data.robots.robot import Reading
from eisp_data.robots.safe_robot import SafeRobot
from eisp_data.robots.twin.robot import TwinRobot

TICK_S = 0.04


class Pushing:
    """A twin with closed fingers, a mover, and the forces of the last ticks."""

    def __init__(self, robot: SafeRobot) -> None:
        self.robot = robot
        self.servo = CartesianServo("ur3", robot.control_hz, fingers_closed=True)
        self.mover = Mover(robot, self.servo)
        self.forces_n: list[float] = []

    def run(self, action: list[float], ticks: int) -> Reading:
        """Return the reading after so many ticks; RobotError if the filter stops the arm."""
        for _ in range(ticks):
            reading = self.robot.observe()
            self.mover.send(np.array(action), reading)
            start = self.robot.now_s()
            for part in range(1, 5):
                self.robot.wait_until(start + part / 4 * TICK_S)
                reading = self.robot.observe()
            force = self.servo.force(reading.joint_position, reading.joint_effort)
            self.forces_n.append(float(np.linalg.norm(force)))
        return reading


@pytest.fixture
def over_a_block():
    """Return a twin whose closed fingers are 2 cm above a block."""
    twin = TwinRobot("push4")
    with SafeRobot(twin) as robot:
        pushing = Pushing(robot)
        z = 1.0
        while z > 0.085:
            reading = pushing.run([0.0, 0.0, -0.2, -1.0], 1)
            x, y, z = pushing.servo.tool_in_task(reading.joint_position)
        twin.referee.move_block(0, np.array([x, y, 0.025]))
        yield pushing


def test_pressing_on_a_block_is_gentle_and_drags_it_nowhere(over_a_block):
    before = over_a_block.servo.tool_in_task(over_a_block.robot.observe().joint_position)
    over_a_block.run([0.0, 0.0, -0.3, -1.0], 15)
    over_a_block.forces_n.clear()
    reading = over_a_block.run([0.0, 0.0, -0.3, -1.0], 35)
    assert np.median(over_a_block.forces_n) < 110.0
    # One that just gives way whenever it is strained wanders off by 13 cm.
    after = over_a_block.servo.tool_in_task(reading.joint_position)
    assert np.linalg.norm((after - before)[:2]) < 0.025
    assert after[2] > 0.055


def test_an_arm_that_has_pressed_goes_away_as_fast_as_ever(over_a_block):
    over_a_block.run([0.0, 0.0, -0.3, -1.0], 30)
    low = over_a_block.servo.tool_in_task(over_a_block.robot.observe().joint_position)
    reading = over_a_block.run([0.0, 0.0, 0.5, -1.0], 12)
    high = over_a_block.servo.tool_in_task(reading.joint_position)
    assert high[2] - low[2] > 0.15
