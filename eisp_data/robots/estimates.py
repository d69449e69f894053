"""What perception believes, and the same as a state of the task's own simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.tool_history import ToolState
from eisp_data.tasks.base import Task


@dataclass(frozen=True)
class ObjectEstimate:
    """One object, in the task's frame."""

    transform_object_to_task: np.ndarray
    """(4, 4)."""
    velocity: np.ndarray
    """(3,) m/s."""
    spin: np.ndarray
    """(3,) rad/s."""
    age_s: float
    """Since the image that last showed it."""
    held: bool
    """Whether it moves with the gripper."""


@dataclass(frozen=True)
class Estimates:
    """All that is believed at one time."""

    tool: ToolState
    objects: dict[str, ObjectEstimate]
    """``block0``... and ``drawer``; those that were never seen are not in it."""


def state_from_estimates(task: Task, estimates: Estimates) -> np.ndarray:
    """Return the task's state (P,) that is as the estimates say.

    Raises:
        RobotError: an object has not been seen yet.
    """
    state = np.zeros(1 + task.model.nq + task.model.nv)
    qpos, qvel = task.qpos(state), task.qvel(state)
    tool = estimates.tool
    state[0] = tool.time_s
    qpos[:3], qpos[3:5] = tool.transform_tool_to_task[:3, 3], tool.opening_m / 2
    qvel[:3], qvel[3:5] = tool.velocity, tool.opening_speed_m_s / 2
    place, speed = 5, 5
    if task.fixtures:
        drawer = _seen(estimates, "drawer")
        qpos[place] = -drawer.transform_object_to_task[0, 3]
        qvel[speed] = -drawer.velocity[0]
        place, speed = place + 1, speed + 1
    for index in range(task.blocks):
        block = _seen(estimates, f"block{index}")
        rotation = upright(block.transform_object_to_task[:3, :3])
        qpos[place : place + 3] = block.transform_object_to_task[:3, 3]
        qpos[place + 3 : place + 7] = quaternion(rotation)
        qvel[speed : speed + 3] = block.velocity
        # MuJoCo has the angular velocity in the frame of the body.
        qvel[speed + 3 : speed + 6] = rotation.T @ block.spin
        place, speed = place + 7, speed + 6
    return state


def upright(rotation: np.ndarray) -> np.ndarray:
    """Return the cube's rotation (3, 3) with the least tilt and the least turn.

    A cube looks the same on each of its faces. Policies know blocks that started upright and
    unturned; on a real table they lie on any face.
    """
    column = int(np.abs(rotation[2]).argmax())
    up = rotation[:, column] * np.sign(rotation[2, column])
    sides = np.delete(rotation, column, axis=1)
    sides = np.concatenate([sides, -sides], axis=1)
    ahead = sides[:, sides[0].argmax()]
    return np.stack([ahead, np.cross(up, ahead), up], axis=1)


def _seen(estimates: Estimates, name: str) -> ObjectEstimate:
    if name not in estimates.objects:
        raise RobotError(f"{name} has not been seen yet")
    return estimates.objects[name]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the (4,) quaternion wxyz of a (3, 3) rotation."""
    import mujoco

    result = np.empty(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation).ravel())
    return result
