"""From what a policy wants to joint targets: streamed displacements, and planned ways.

Joint targets that come from here are smooth on their own; ``safety`` still has the last word.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from eisp_data.errors import RobotError
from eisp_data.robots.arms import get_arm
from eisp_data.robots.kinematics import Kinematics
from eisp_data.robots.robot import JointCommand, JointLimits
from eisp_data.sim.scene import FINGER_TRAVEL_M, WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from eisp_data.tasks.base import ACTION_SCALE_M

POLICY_HZ = 25.0
"""ACTION_SCALE_M is the way of one period of this rate."""

_ACCELERATION_M_S2 = 8.0
"""Of the tool; full speed within an eighth of a second."""
_TURN_RAD_S = 1.0
"""How fast a tool that was tilted comes upright again: at once would be a jump of the joints."""
_OPEN_M = 2 * FINGER_TRAVEL_M

_PEAK_VELOCITY, _PEAK_ACCELERATION = 1.875, 10.0 / 3.0**0.5
"""Of a minimum-jerk move by 1 in 1 s."""
_SHARE = 0.8
"""Of the limits that a planned way uses, so that the filter has nothing to do."""


class CartesianServo:
    """Turns the policies' actions into joint targets, the fingers pointing down all the while.

    Where something has tilted them they come upright again, bit by bit.

    Attributes:
        fingers_closed: whether the gripper stays closed whatever the actions say.
    """

    def __init__(
        self,
        arm: str,
        control_hz: float,
        transform_task_to_base: np.ndarray | None = None,
        speed: float = 1.0,
        fingers_closed: bool = False,
    ) -> None:
        """Prepare; call ``start`` first.

        Args:
            arm: a name in ``ARMS``.
            control_hz: how often ``step`` is called.
            transform_task_to_base: (4, 4), the arm's usual one if left out.
            speed: share of the speed that the policies were trained with.
            fingers_closed: the gripper stays closed whatever the action says, as in ``Task``.
        """
        placed = transform_task_to_base
        self._placed = get_arm(arm).transform_task_to_base if placed is None else placed
        self._kinematics = Kinematics(arm)
        self._period_s, self._speed = 1.0 / control_hz, speed
        self.fingers_closed = fingers_closed
        self._here: np.ndarray | None = None

    def tool_in_task(self, joint_position: np.ndarray) -> np.ndarray:
        """Return the (3,) point between the fingertips in the task's frame, at (J,) rad."""
        return self._to_task(self._kinematics.forward(joint_position)[:3, 3])

    def start(self) -> None:
        """Begin from an arm at rest."""
        self._here = None

    def step(self, action: np.ndarray, sent: np.ndarray) -> JointCommand:
        """Return the targets of one control period.

        Args:
            action: (4,) in [-1, 1]: displacement of the tool in the task's frame, and the gripper;
                beyond that it is clipped, and one that is not finite is standing still.
            sent: (J,) rad, what the robot was really sent last (its reading, at first). The tool
                moves from there, so that it never runs ahead of an arm that was held back.
        """
        action = np.asarray(action, float)
        way = action[:3] if np.isfinite(action[:3]).all() else np.zeros(3)
        pose = self._kinematics.forward(sent)
        here = self._to_task(pose[:3, 3])
        moving = np.zeros(3) if self._here is None else (here - self._here) / self._period_s
        wanted = self._speed * ACTION_SCALE_M * POLICY_HZ * np.clip(way, -1.0, 1.0)
        change = wanted - moving
        most = _ACCELERATION_M_S2 * self._period_s
        velocity = moving + change * min(1.0, most / max(float(np.linalg.norm(change)), 1e-12))
        # An arm that starts outside the workspace comes in at the same speed.
        target = here + self._period_s * velocity
        target = np.maximum(target, np.minimum(here, WORKSPACE_LOW_M))
        target = np.minimum(target, np.maximum(here, WORKSPACE_HIGH_M))
        self._here = here
        # What is not a number stays one: the filter then leaves the gripper as it is.
        opening = float(np.clip((action[3] + 1.0) / 2.0, 0.0, 1.0)) * _OPEN_M
        if self.fingers_closed:
            opening = 0.0
        wanted_pose = fingers_down(target, self._placed)
        wanted_pose[:3, :3] = self._turned(pose[:3, :3], wanted_pose[:3, :3])
        return JointCommand(self._kinematics.track(wanted_pose, sent), opening)

    def give_way(self, joint_position: np.ndarray) -> np.ndarray:
        """Return the targets (J,) rad that leave an arm where it was pressed to, at (J,) rad.

        Where that is outside of the workspace it is brought back: a filter would not let it stay.
        It stays as tilted as it was pressed: what straightened it would press on.
        """
        here = self.tool_in_task(joint_position)
        inside = np.clip(here, WORKSPACE_LOW_M, WORKSPACE_HIGH_M)
        if np.array_equal(here, inside):
            return joint_position
        pose = self._kinematics.forward(joint_position)
        pose[:3, 3] += self._placed[:3, :3] @ (inside - here)
        return self._kinematics.track(pose, joint_position)

    def force(self, joint_position: np.ndarray, joint_effort: np.ndarray) -> np.ndarray:
        """Return the force (3,) N, task's frame, with which a slow arm of (J,) N m presses."""
        jacobian = self._kinematics.jacobian(joint_position)
        wrench = np.linalg.lstsq(jacobian.T, joint_effort, rcond=0.01)[0]
        return self._placed[:3, :3].T @ wrench[:3]

    def held_back(
        self, wanted: np.ndarray, sent: np.ndarray, direction: np.ndarray, most_m: float
    ) -> np.ndarray:
        """Return the targets (J,) rad that go no further than so far in a direction.

        Args:
            wanted: (J,) rad, where the arm would go.
            sent: (J,) rad, from where.
            direction: (3,), of length 1, in the task's frame.
            most_m: how far it may go that way; below 0 it has to go back.
        """
        pose = self._kinematics.forward(wanted)
        way = self._to_task(pose[:3, 3]) - self.tool_in_task(sent)
        excess = float(way @ direction) - most_m
        if excess <= 0.0:
            return wanted
        pose[:3, 3] -= self._placed[:3, :3] @ (excess * direction)
        return self._kinematics.track(pose, sent)

    def _to_task(self, point: np.ndarray) -> np.ndarray:
        """Return a point (3,) of the base's frame in the task's."""
        return self._placed[:3, :3].T @ (point - self._placed[:3, 3])

    def _turned(self, rotation: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Return the (3, 3) rotation one control period on from one towards another."""
        turn = pin.log3(rotation.T @ wanted)
        most = _TURN_RAD_S * self._period_s
        return rotation @ pin.exp3(turn * min(1.0, most / max(float(np.linalg.norm(turn)), 1e-12)))


def joint_path(
    waypoints: np.ndarray, limits: JointLimits, control_hz: float, speed: float = 1.0
) -> np.ndarray:
    """Return the targets (N, J) of a smooth move through (W, J) rad, resting at each.

    Each stretch is straight and has least jerk, as fast as velocity and acceleration allow.

    Args:
        waypoints: the first is where the arm is.
        limits: of the robot.
        control_hz: rows a second.
        speed: share of the greatest speed, in (0, 1].
    """
    rows = []
    for start, end in zip(waypoints[:-1], waypoints[1:], strict=True):
        way = np.abs(end - start)
        by_velocity = (_PEAK_VELOCITY * way / (_SHARE * limits.velocity)).max()
        by_acceleration = ((_PEAK_ACCELERATION * way / (_SHARE * limits.acceleration)) ** 0.5).max()
        seconds = max(by_velocity, by_acceleration) / speed
        count = max(1, int(np.ceil(seconds * control_hz)))
        t = np.arange(1, count + 1) / count
        done = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
        rows.append(start + np.outer(done, end - start))
    return np.concatenate(rows) if rows else np.empty((0, waypoints.shape[1]))


def fingers_down(point_in_task_m: np.ndarray, transform_task_to_base: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4), tool to base, with the fingers down at a (3,) point of the task.

    Raises:
        RobotError: the point is not finite.
    """
    if not np.isfinite(point_in_task_m).all():
        raise RobotError(f"a goal must be finite, not {point_in_task_m}")
    pose = transform_task_to_base.copy()
    pose[:3, 3] += transform_task_to_base[:3, :3] @ point_in_task_m
    return pose
