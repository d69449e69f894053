"""Camera and hand-eye calibration: from images of a board that a moving gripper holds.

OpenCV gives the start (``calibrateCamera``, then ``calibrateHandEye`` by Daniilidis' dual
quaternions); the result is one fit of everything, lens, camera and board, to all corners at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.cell import apply, inverse, transform
from eisp_data.robots.charuco import BoardView
from eisp_data.robots.robot import CameraIntrinsics

LEAST_VIEWS = 12
_MOST_PX = 1.5
_LENS = 9
"""Focal lengths, centre, and OpenCV's five of distortion."""
_HUBER_PX = 0.5
_ITERATIONS = 40
_STEPS = np.concatenate([[1e-3] * 4, [1e-6] * 17])
"""Of the numerical derivatives: pixels, then distortion, radians and metres."""


@dataclass(frozen=True)
class HandEye:
    """The result."""

    intrinsics: CameraIntrinsics
    transform_camera_to_base: np.ndarray
    """(4, 4)."""
    transform_board_to_tool: np.ndarray
    """(4, 4)."""
    error_px: float
    """Root mean square distance of the corners from where all this has them."""
    board_error_m: float
    """Median distance between where the camera and where the joints have the board."""


def solve_hand_eye(
    views: list[BoardView], tools: list[np.ndarray], width: int, height: int
) -> HandEye:
    """Return lens, camera and board that fit all images.

    Args:
        views: of the board, one an image.
        tools: (4, 4) each, the tool's pose to the base then.
        width: of the images, pixels.
        height: of the images, pixels.

    Raises:
        RobotError: there are too few images, or they fit no camera.
    """
    import cv2

    if len(views) < LEAST_VIEWS:
        raise RobotError(
            f"the camera saw the board in {len(views)} images only; {LEAST_VIEWS} are needed"
        )
    _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        [view.points.astype(np.float32) for view in views],
        [view.pixels.astype(np.float32) for view in views],
        (width, height),
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )
    bases = [inverse(tool) for tool in tools]
    # With the board in the hand and the camera at rest the roles of hand and base are exchanged.
    rotation, shift = cv2.calibrateHandEye(
        [base[:3, :3] for base in bases],
        [base[:3, 3] for base in bases],
        turns,
        shifts,
        method=cv2.CALIB_HAND_EYE_DANIILIDIS,
    )
    camera = transform(rotation, shift.ravel())
    boards = [transform(cv2.Rodrigues(t)[0], s.ravel()) for t, s in zip(turns, shifts, strict=True)]
    held = bases[0] @ camera @ boards[0]
    lens = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]]
    start = np.concatenate([lens, _vector(inverse(camera)), _vector(held)])
    best = _refine(start, views, tools)
    error_px = float(np.sqrt(2 * np.mean(_residuals(best, views, tools) ** 2)))
    if not error_px <= _MOST_PX:
        raise RobotError(
            f"the images fit no camera: {error_px:.1f} pixels are left; was the board moved in the "
            "gripper, or its printed size wrong?"
        )
    matrix, distortion = _lens(best)
    camera, held = inverse(_transform(best[_LENS : _LENS + 6])), _transform(best[_LENS + 6 :])
    return HandEye(
        intrinsics=CameraIntrinsics(width, height, matrix, distortion),
        transform_camera_to_base=camera,
        transform_board_to_tool=held,
        error_px=error_px,
        board_error_m=_board_error(views, tools, matrix, distortion, camera, held),
    )


def _refine(start: np.ndarray, views: list[BoardView], tools: list[np.ndarray]) -> np.ndarray:
    """Return the unknowns (21,) with the least error: Levenberg-Marquardt, with Huber's weights."""
    best, damping = start, 1e-3
    residual = _residuals(best, views, tools)
    for _ in range(_ITERATIONS):
        slope = np.stack(
            [
                (_residuals(best + step * axis, views, tools) - residual) / step
                for step, axis in zip(_STEPS, np.eye(len(best)), strict=True)
            ],
            axis=1,
        )
        weight = np.minimum(1.0, _HUBER_PX / np.maximum(np.abs(residual), 1e-9))
        matrix = slope.T @ (weight[:, None] * slope)
        # What the images say nothing about (the fifth coefficient) stays as it is.
        matrix.flat[:: len(best) + 1] += damping * np.diag(matrix) + 1e-12
        there = best - np.linalg.solve(matrix, slope.T @ (weight * residual))
        after = _residuals(there, views, tools)
        if _cost(after) >= _cost(residual):
            damping *= 10
            continue
        small = _cost(residual) - _cost(after) < 1e-9 * _cost(residual)
        best, residual, damping = there, after, damping / 10
        if small:
            break
    return best


def _cost(residual: np.ndarray) -> float:
    """Return Huber's cost."""
    size = np.abs(residual)
    inside = size <= _HUBER_PX
    return float(np.where(inside, size**2, 2 * _HUBER_PX * size - _HUBER_PX**2).sum())


def _residuals(unknowns: np.ndarray, views: list[BoardView], tools: list[np.ndarray]) -> np.ndarray:
    """Return how far all corners are from where they are seen, (2 N,) px."""
    import cv2

    matrix, distortion = _lens(unknowns)
    to_camera = _transform(unknowns[_LENS : _LENS + 6])
    held = _transform(unknowns[_LENS + 6 :])
    points = np.concatenate(
        [apply(tool @ held, view.points) for view, tool in zip(views, tools, strict=True)]
    )
    seen = np.concatenate([view.pixels for view in views])
    zero = np.zeros(3)
    there = cv2.projectPoints(apply(to_camera, points), zero, zero, matrix, distortion)[0][:, 0]
    return (there - seen).ravel()


def _board_error(
    views: list[BoardView],
    tools: list[np.ndarray],
    matrix: np.ndarray,
    distortion: np.ndarray,
    camera: np.ndarray,
    held: np.ndarray,
) -> float:
    import cv2

    distances = []
    for view, tool in zip(views, tools, strict=True):
        _, turn, shift = cv2.solvePnP(view.points, view.pixels, matrix, distortion)
        middle = view.points.mean(axis=0)
        seen = camera @ transform(cv2.Rodrigues(turn)[0], shift.ravel())
        distances.append(np.linalg.norm(apply(seen, middle) - apply(tool @ held, middle)))
    return float(np.median(distances))


def _lens(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = unknowns[:4]
    # The fifth coefficient of so narrow a lens cannot be told from the others.
    distortion = np.append(unknowns[4:8], 0.0)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion


def _vector(transform_: np.ndarray) -> np.ndarray:
    import cv2

    return np.concatenate([cv2.Rodrigues(transform_[:3, :3])[0].ravel(), transform_[:3, 3]])


def _transform(vector: np.ndarray) -> np.ndarray:
    import cv2

    return transform(cv2.Rodrigues(vector[:3])[0], vector[3:])
