"""The cell as it is designed: where arm, gripper, table and camera are to one another.

The task's frame (see ``eisp_data.sim.scene``) lies on the table top. The UR3 stands on a pedestal
behind and above it, because there its 0.5 m reach covers the workspace with the fingers pointing
down. A real cell replaces these figures by its own, in a calibration file
(``eisp_data.robots.calibration``); the twin is built by them.

A transform ``transform_a_to_b`` is a (4, 4) matrix that maps points given in frame a to frame b.
"""

from __future__ import annotations

import numpy as np

BASE_IN_TASK_M = (-0.05, 0.0, 0.255)
"""The arm's ``base_link`` in the task's frame; its axes are parallel to the task's. A centimetre
further back, and the far corners are out of reach."""

PEDESTAL_HALF_M = 0.06
"""Half the width of the square column under the arm; the forearm comes near to a wider one."""

TOOL_LENGTH_M = 0.165
"""From the flange (the URDF's ``tool0``) to the point between the fingertips."""

HOME_RAD = (-0.318, -0.880, 1.955, -2.646, -1.571, -1.889)
"""The UR3's joints with the open fingers pointing down over the middle of the workspace."""

CAMERA_IN_TASK_M = (0.84, 0.0, 0.70)
CAMERA_LOOKS_AT_M = (0.31, 0.0, 0.035)
"""The camera looks down from opposite the arm: so it sees a block that is held by two of its
faces, where a camera straight above would see the wrist only."""

CAMERA_SIZE = (640, 480)
CAMERA_FOCAL_PX = 920.0
"""A 640x480 window in the middle of the D435i's 1280x720 colour image (its focal length there);
scaled down from the full image a marker would have a third fewer pixels."""


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform of a (3, 3) rotation and a (3,) translation."""
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = translation
    return result


def inverse(transform_a_to_b: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform b to a."""
    rotation = transform_a_to_b[:3, :3]
    return transform(rotation.T, -rotation.T @ transform_a_to_b[:3, 3])


def apply(transform_a_to_b: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (..., 3) points given in frame a as points in frame b."""
    return points @ transform_a_to_b[:3, :3].T + transform_a_to_b[:3, 3]


def transform_task_to_base() -> np.ndarray:
    """Return (4, 4): the task's frame in the arm's ``base_link``."""
    return transform(np.eye(3), -np.array(BASE_IN_TASK_M))


def transform_tool_to_flange() -> np.ndarray:
    """Return (4, 4): the point between the fingertips in the flange.

    With the fingers pointing down the tool's axes are parallel to the task's: z up, and the fingers
    open along y.
    """
    return transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, TOOL_LENGTH_M]))


def transform_camera_to_task() -> np.ndarray:
    """Return (4, 4): the camera's frame (x right, y down, z forward) in the task's."""
    position = np.array(CAMERA_IN_TASK_M)
    forward = np.array(CAMERA_LOOKS_AT_M) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return transform(np.stack([right, np.cross(forward, right), forward], axis=1), position)
