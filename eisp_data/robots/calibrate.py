"""Calibrating a cell: the gripper shows a board to the camera, then the camera finds the table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.arms import get_arm
from eisp_data.robots.aruco import MarkerDetector
from eisp_data.robots.calibration import Calibration, CameraCalibration
from eisp_data.robots.cell import transform
from eisp_data.robots.charuco import BoardDetector, BoardView
from eisp_data.robots.collision import CollisionChecker
from eisp_data.robots.hand_eye import LEAST_VIEWS, solve_hand_eye
from eisp_data.robots.kinematics import kinematics
from eisp_data.robots.markers import table_markers
from eisp_data.robots.motion import joint_path
from eisp_data.robots.planning import plan
from eisp_data.robots.pose import View, fit_pose
from eisp_data.robots.robot import CameraFrame, JointCommand, Robot

_PLACES_LOW_M, _PLACES_HIGH_M = np.array([0.22, -0.12, 0.06]), np.array([0.41, 0.12, 0.15])
"""Of the tool, in the task's frame."""
_TILT_RAD, _TURN_RAD = 0.35, 0.5
_SPEED = 0.5
_REST_S = 0.25
_WAIT_S = 1.0
_CLOSE_RAD = 1.2
"""The arm goes straight from posture to posture: they have to be of one family."""


def calibrate_cell(
    robot: Robot, camera: str, views: int, seed: int, progress: Any = iter
) -> Calibration:
    """Move the arm so that the camera sees the board it holds; return what that says.

    Args:
        robot: connected, the board in its gripper, nothing else on the table.
        camera: the camera's name.
        views: how many postures.
        seed: of the postures.
        progress: wraps the postures to show how far it is, as ``tqdm`` does.

    Raises:
        RobotError: the board or the table's markers are not seen, or fit no camera.
    """
    arm = kinematics(robot.arm)
    detector = BoardDetector()
    seen: list[BoardView] = []
    tools: list[np.ndarray] = []
    home = robot.observe()
    postures = list(_postures(robot, views, seed))
    for number, posture in enumerate(progress(postures)):
        _go(robot, posture)
        view = detector.detect(_fresh_frame(robot, camera).image)
        if view is not None:
            seen.append(view)
            tools.append(arm.forward(robot.observe().joint_position))
        elif number + 1 >= LEAST_VIEWS and not seen:
            raise RobotError(f"camera {camera!r} does not see the board in the gripper")
    _go(robot, home.joint_position)
    lens = robot.cameras[camera]
    found = solve_hand_eye(seen, tools, lens.width, lens.height)
    placed = CameraCalibration(found.intrinsics, found.transform_camera_to_base)
    task = _find_table(placed, _fresh_frame(robot, camera).image)
    quality = {
        "reprojection_error_px": round(found.error_px, 4),
        "board_error_mm": round(1000 * found.board_error_m, 3),
        "images": float(len(seen)),
    }
    tool = get_arm(robot.arm).transform_tool_to_tip
    return Calibration(robot.name, {camera: placed}, task, tool, quality)


def _postures(robot: Robot, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield postures (J,) that show the board from many sides, and are near one another."""
    arm, rng = kinematics(robot.arm), np.random.default_rng(seed)
    clear = CollisionChecker(robot.arm).is_clear
    placed = get_arm(robot.arm).transform_task_to_base
    start = robot.observe().joint_position
    found = 0
    for _ in range(20 * count):
        if found == count:
            return
        tilt = rng.uniform([-_TILT_RAD, -_TILT_RAD, -_TURN_RAD], [_TILT_RAD, _TILT_RAD, _TURN_RAD])
        pose = placed @ transform(_turn(tilt), rng.uniform(_PLACES_LOW_M, _PLACES_HIGH_M))
        posture = arm.track(pose, start)
        there = arm.forward(posture)
        reached = np.abs(there - pose).max() < 0.01
        if reached and np.abs(posture - start).max() < _CLOSE_RAD and clear(posture):
            found += 1
            yield posture
    raise RobotError(f"only {found} of {count} postures that show the board can be reached")


def _go(robot: Robot, posture: np.ndarray) -> None:
    """Move to (J,) rad, and come to rest."""
    here, clear = robot.observe().joint_position, CollisionChecker(robot.arm).is_clear
    ways = plan(here, posture, robot.limits, clear)
    rest = np.tile(posture, (round(_REST_S * robot.control_hz), 1))
    path = joint_path(ways, robot.limits, robot.control_hz, _SPEED)
    for target in np.concatenate([path, rest]):
        _tick(robot, target)


def _tick(robot: Robot, target: np.ndarray) -> None:
    """Head for (J,) rad for one control period; the gripper keeps hold of the board."""
    deadline = robot.now_s() + 1 / robot.control_hz
    robot.command(JointCommand(target, robot.observe().gripper_opening_m))
    robot.wait_until(deadline)


def _fresh_frame(robot: Robot, camera: str) -> CameraFrame:
    """Return an image that was captured from now on, by a robot that stands still."""
    start, posture = robot.now_s(), robot.observe().joint_position
    while robot.now_s() < start + _WAIT_S:
        frame = robot.frames().get(camera)
        if frame is not None and frame.captured_s >= start:
            return frame
        _tick(robot, posture)
    raise RobotError(f"camera {camera!r} gives no images")


def _find_table(camera: CameraCalibration, image: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform of the task's frame to the base, from the table's markers."""
    view = View(camera, np.eye(4))
    found = MarkerDetector().detect(image)
    rays = dict(zip(found.numbers.tolist(), view.undistort(found.corners), strict=True))
    table = table_markers()
    fit = fit_pose(view, table, rays)
    if fit is None:
        numbers = ", ".join(str(marker.number) for marker in table.markers)
        raise RobotError(f"the camera does not see the table's markers {numbers}")
    return fit.transform_object_to_task


def _turn(vector: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(vector)[0]
