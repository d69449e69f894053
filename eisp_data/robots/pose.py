"""The pose of a body from the corners of all its visible markers.

One fit for all corners (Gauss-Newton on the reprojection error, Huber's weights against corners
that are wrong), with what is known besides the image as Gaussian priors: a block mostly lies flat,
at the height of what is below it. The priors settle which of the two poses of a single square it
is, and take most of the error along the line of sight away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.robots.calibration import CameraCalibration
from eisp_data.robots.cell import apply, inverse, transform
from eisp_data.robots.markers import MarkedObject, Marker

CORNER_STD_PX = 0.25
"""Of a corner: 0.1 px was measured in the twin, and calibration adds its part."""
_HUBER = 3.0
"""In standard deviations."""
_STEPS = 12
_CONVERGED = 1e-5
"""rad and m."""
_MOST_PX = 1.2
"""A fit with a larger error is none."""
_GOOD_PX = 0.35
"""A guess that leads to a fit so good needs no rival."""
_QUARTER_TURN = transform(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.zeros(3))
_STARTS = 2
"""How many markers, the largest first, are asked for a pose to start from."""


@dataclass(frozen=True)
class Priors:
    """What is known of a pose besides the image."""

    tilt_std: float | None = None
    """rad, by which some axis of the body is off the vertical; None if any tilt will do."""
    height_m: float = 0.0
    height_std_m: float | None = None
    """Of the position's z; None if any height will do."""


@dataclass(frozen=True)
class PoseFit:
    """A pose with its accuracy."""

    transform_object_to_task: np.ndarray
    """(4, 4)."""
    error_px: float
    """Root mean square distance of the corners from where the pose has them, wrong ones left
    out."""
    covariance: np.ndarray
    """(3, 3) m^2, of the position in the task's frame."""
    cost: float
    """Of corners and priors, in units of variance."""

    @property
    def position_std_m(self) -> float:
        """Standard deviation of the position along its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


class View:
    """A calibrated camera that looks at the task's frame."""

    def __init__(self, camera: CameraCalibration, transform_base_to_task: np.ndarray) -> None:
        self.intrinsics = camera.intrinsics
        self.transform_camera_to_task = transform_base_to_task @ camera.transform_camera_to_base
        self._to_camera = inverse(self.transform_camera_to_task)
        self.focal_px = float(np.sqrt(np.prod(np.diag(camera.intrinsics.matrix)[:2])))

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Return where (..., 2) px are on the plane at depth 1, (..., 2)."""
        import cv2

        flat = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        lens = self.intrinsics
        return cv2.undistortPoints(flat, lens.matrix, lens.distortion).reshape(pixels.shape)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return where (N, 3) points in the task's frame are in the image, (N, 2) px."""
        import cv2

        there = apply(self._to_camera, points)
        lens = self.intrinsics
        zero = np.zeros(3)
        return cv2.projectPoints(there, zero, zero, lens.matrix, lens.distortion)[0][:, 0]

    def residuals(self, points: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far points are from where they are seen, and how that changes with them.

        Args:
            points: (N, 3) in the task's frame.
            rays: (N, 2) from ``undistort``.

        Returns:
            (N, 2) px, and (N, 2, 3) px per metre.
        """
        there = apply(self._to_camera, points)
        depth = np.maximum(there[:, 2:], 0.01)
        on_plane = there[:, :2] / depth
        by_camera = np.zeros((len(points), 2, 3))
        by_camera[:, 0, 0] = by_camera[:, 1, 1] = 1 / depth[:, 0]
        by_camera[:, :, 2] = -on_plane / depth
        by_point = self.focal_px * by_camera @ self._to_camera[:3, :3]
        return self.focal_px * (on_plane - rays), by_point


def fit_pose(
    view: View,
    item: MarkedObject,
    rays: dict[int, np.ndarray],
    guess: np.ndarray | None = None,
    priors: Priors | None = None,
) -> PoseFit | None:
    """Return the pose of an object, None if none fits its markers.

    Args:
        view: the camera.
        item: the object.
        rays: (4, 2) from ``View.undistort`` by marker number; those of other objects are ignored.
        guess: (4, 4) object to task, if there is a likely one.
        priors: what is known besides.
    """
    priors = Priors() if priors is None else priors
    seen = [marker for marker in item.markers if marker.number in rays]
    if not seen:
        return None
    points = np.concatenate([marker.corners() for marker in seen])
    targets = np.concatenate([rays[marker.number] for marker in seen])
    fits: list[PoseFit] = []
    if guess is not None:
        fits.append(_descend(view, points, targets, guess, priors))
        if fits[0].error_px <= _GOOD_PX:
            return fits[0]
    largest = sorted(seen, key=lambda m: -float(np.ptp(rays[m.number], axis=0).min()))
    for marker in largest[:_STARTS]:
        for start in _square_poses(view, marker, rays[marker.number]):
            fits.append(_descend(view, points, targets, start, priors))
    best = min(fits, key=lambda fit: fit.cost)
    return None if best.error_px > _MOST_PX else best


def fit_slide(
    view: View, item: MarkedObject, rays: dict[int, np.ndarray], axis: np.ndarray, guess_m: float
) -> tuple[float, float] | None:
    """Return how far a body has slid, and the standard deviation of that, metres; or None.

    Args:
        view: the camera.
        item: the body; its frame is the task's when it has not slid.
        rays: as in ``fit_pose``.
        axis: (3,) unit vector, task's frame.
        guess_m: to start from.
    """
    seen = [marker for marker in item.markers if marker.number in rays]
    if not seen:
        return None
    points = np.concatenate([marker.corners() for marker in seen])
    targets = np.concatenate([rays[marker.number] for marker in seen])
    slid = guess_m
    for _ in range(_STEPS):
        residual, by_point = view.residuals(points + slid * axis, targets)
        slope = by_point @ axis
        weight = _weights(residual)[:, None]
        information = (weight * slope * slope).sum()
        step = -(weight * slope * residual).sum() / information
        slid += step
        if abs(step) < _CONVERGED:
            break
    if _error_px(residual) > _MOST_PX:
        return None
    return float(slid), float(CORNER_STD_PX / np.sqrt(information))


def _square_poses(view: View, marker: Marker, rays: np.ndarray) -> list[np.ndarray]:
    """Return the two poses (4, 4), object to task, that one marker alone may have."""
    import cv2

    half = marker.size_m / 2
    square = half * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    # OpenCV garbles rotations by exactly half a turn, and so one sees the top of a block that lies
    # straight: it is asked for the marker a quarter turn on.
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square, np.roll(rays, 1, axis=0)[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    back = _QUARTER_TURN @ inverse(marker.transform_marker_to_object)
    return [
        view.transform_camera_to_task
        @ transform(cv2.Rodrigues(turns[i])[0], shifts[i].ravel())
        @ back
        for i in range(count)
    ]


def _descend(
    view: View, points: np.ndarray, rays: np.ndarray, start: np.ndarray, priors: Priors
) -> PoseFit:
    """Fit (N, 3) points of the object to (N, 2) rays."""
    rotation, position = start[:3, :3].copy(), start[:3, 3].copy()
    for _ in range(_STEPS):
        matrix, gradient, residual, cost = _normal_equations(
            view, points, rays, rotation, position, priors
        )
        step = -np.linalg.solve(matrix, gradient)
        length = np.abs(step).max()
        if length > 0.5:
            step *= 0.5 / length
        rotation = _turn(step[:3]) @ rotation
        position = position + step[3:]
        if length < _CONVERGED:
            break
    return PoseFit(
        transform_object_to_task=transform(rotation, position),
        error_px=_error_px(residual),
        covariance=np.linalg.inv(matrix)[3:, 3:],
        cost=cost,
    )


def _normal_equations(
    view: View,
    points: np.ndarray,
    rays: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
    priors: Priors,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return matrix (6, 6) and gradient (6,) for a turn and a shift, residuals (N, 2) px, cost."""
    arm = points @ rotation.T
    residual, by_point = view.residuals(arm + position, rays)
    # A small turn w moves a point by w x arm.
    by_turn = by_point @ _cross_matrices(arm)
    slope = np.concatenate([by_turn, by_point], axis=-1).reshape(-1, 6) / CORNER_STD_PX
    scaled = residual.ravel() / CORNER_STD_PX
    weight = np.repeat(_weights(residual), 2)
    weighted = slope.T * weight
    matrix, gradient = weighted @ slope, weighted @ scaled
    cost = float(weight @ scaled**2)
    # Never singular, however few the corners.
    matrix.flat[::7] += 1e-6
    if priors.height_std_m is not None:
        off = (position[2] - priors.height_m) / priors.height_std_m
        matrix[5, 5] += 1 / priors.height_std_m**2
        gradient[5] += off / priors.height_std_m
        cost += off**2
    if priors.tilt_std is not None:
        # The axis that is nearest to the vertical, and how a turn moves its x and y.
        column = np.abs(rotation[2]).argmax()
        up = rotation[:, column] * np.sign(rotation[2, column])
        by_tilt = np.array([[0, up[2], -up[1]], [-up[2], 0, up[0]]]) / priors.tilt_std
        off = up[:2] / priors.tilt_std
        matrix[:3, :3] += by_tilt.T @ by_tilt
        gradient[:3] += by_tilt.T @ off
        cost += float(off @ off)
    return matrix, gradient, residual, cost


def _cross_matrices(arm: np.ndarray) -> np.ndarray:
    """Return the (N, 3, 3) matrices that take a turn (3,) to how it moves each of (N, 3) arms."""
    matrices = np.zeros((len(arm), 3, 3))
    x, y, z = arm.T
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = z, -y, x
    matrices[:, 1, 0], matrices[:, 2, 0], matrices[:, 2, 1] = -z, y, -x
    return matrices


def _weights(residual: np.ndarray) -> np.ndarray:
    """Return Huber's weights (N,) of (N, 2) residuals in pixels."""
    distance = np.linalg.norm(residual, axis=-1) / CORNER_STD_PX
    return np.minimum(1.0, _HUBER / np.maximum(distance, 1e-9))


def _error_px(residual: np.ndarray) -> float:
    """Return the error of the better three quarters of the corners; of all, if there are four.

    Three corners fit a pose whatever they are.
    """
    square = np.sort((residual**2).sum(axis=-1))
    count = len(square) if len(square) == 4 else 3 * len(square) // 4
    return float(np.sqrt(square[:count].mean()))


def _turn(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation by a rotation vector (3,)."""
    import cv2

    return cv2.Rodrigues(vector)[0]
