"""Markers in an image: found by OpenCV, their corners then fitted to the edges of the print.

OpenCV's own refinements leave some 0.3 pixels (measured in the twin at 45 pixels a marker); lines
through the edges, which use all of the outline, leave a third of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.robots.markers import dictionary

_SAMPLES = 12
"""Places along an edge at which it is looked for."""
_FIRST, _LAST = 0.12, 0.88
"""Between these shares of an edge: its ends are rounded by the lens."""
_REACH_PX = 2.5
_PROFILE = 11
"""Samples across an edge, over twice the reach."""
_PEAK = 3
"""Samples on each side of the steepest one that count."""
_FAINT = 25.0
"""Grey levels across an edge below which it is none."""
_ROUNDS = 2
_STRAY_PX = 0.35


@dataclass(frozen=True)
class Detections:
    """The markers in one image."""

    numbers: np.ndarray
    """(M,) their ids."""
    corners: np.ndarray
    """(M, 4, 2) px, clockwise from the top left one as the marker is read."""


class MarkerDetector:
    """Finds the markers of the dictionary in images."""

    def __init__(self) -> None:
        import cv2

        settings = cv2.aruco.DetectorParameters()
        # Two sizes of window are enough for prints of one size, and a third faster than three.
        settings.adaptiveThreshWinSizeMin, settings.adaptiveThreshWinSizeMax = 3, 23
        settings.adaptiveThreshWinSizeStep = 20
        self._detector = cv2.aruco.ArucoDetector(dictionary(), settings)

    def detect(self, image: np.ndarray) -> Detections:
        """Return the markers in an (H, W, 3) uint8 RGB image, each id at most once."""
        import cv2

        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found, numbers, _ = self._detector.detectMarkers(grey)
        if numbers is None:
            return Detections(np.empty(0, np.int64), np.empty((0, 4, 2)))
        numbers = numbers.ravel().astype(np.int64)
        corners = np.concatenate(found).astype(np.float64)
        # One that is seen twice is mistaken for another at least once.
        once = np.array([(numbers == number).sum() == 1 for number in numbers])
        numbers, corners = numbers[once], corners[once]
        return (
            Detections(numbers, refine(grey, corners))
            if len(numbers)
            else Detections(numbers, corners)
        )


def refine(grey: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the corners as the crossings of lines fitted to the markers' edges.

    Args:
        grey: (H, W) uint8.
        corners: (M, 4, 2) px, within two pixels of the right ones. An edge that is not there (it
            is covered, or its end is wrong) leaves the corners at its ends as they were.

    Returns:
        (M, 4, 2) px.
    """
    points, found = _edge_points(grey, corners)
    normals, offsets, good = _fit_lines(points, found)
    before_n, before_o = np.roll(normals, 1, axis=1), np.roll(offsets, 1, axis=1)
    cross = before_n[..., 0] * normals[..., 1] - before_n[..., 1] * normals[..., 0]
    good = good & np.roll(good, 1, axis=1) & (np.abs(cross) > 0.1)
    cross = np.where(good, cross, 1.0)
    x = (before_o * normals[..., 1] - offsets * before_n[..., 1]) / cross
    y = (before_n[..., 0] * offsets - normals[..., 0] * before_o) / cross
    fitted = np.stack([x, y], axis=-1)
    near = np.linalg.norm(fitted - corners, axis=-1) <= 2 * _REACH_PX
    return np.where((good & near)[..., None], fitted, corners)


def _edge_points(grey: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (M, 4, S, 2) on the four edges of each marker, and which were found."""
    import cv2

    start, end = corners, np.roll(corners, -1, axis=1)
    along = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    share = np.linspace(_FIRST, _LAST, _SAMPLES)
    places = start[:, :, None] + (end - start)[:, :, None] * share[:, None]
    across = np.linspace(-_REACH_PX, _REACH_PX, _PROFILE)
    pixels = (places[:, :, :, None] + outward[:, :, None, None] * across[:, None]).astype(
        np.float32
    )
    profile = cv2.remap(
        grey, pixels[..., 0].reshape(-1, 1), pixels[..., 1].reshape(-1, 1), cv2.INTER_LINEAR
    ).reshape(pixels.shape[:-1])
    # Dark inside, light outside.
    rise = np.clip(np.diff(profile.astype(np.float64), axis=-1), 0.0, None)
    middle = (across[1:] + across[:-1]) / 2
    steepest = rise.argmax(axis=-1)[..., None]
    rise[np.abs(np.arange(_PROFILE - 1) - steepest) > _PEAK] = 0.0
    total = rise.sum(axis=-1)
    shift = (rise * middle).sum(axis=-1) / np.maximum(total, 1e-9)
    return places + outward[:, :, None] * shift[..., None], total > _FAINT


def _fit_lines(points: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines through (M, 4, S, 2) points: normals, offsets, and whether there are any.

    Points away from the line of the others are left out in the second round.
    """
    weight = found.astype(np.float64)
    for _ in range(_ROUNDS):
        count = np.maximum(weight.sum(axis=-1), 1.0)
        centre = (weight[..., None] * points).sum(axis=2) / count[..., None]
        offset = points - centre[:, :, None]
        x, y = offset[..., 0], offset[..., 1]
        xx, yy, xy = ((weight * a).sum(axis=-1) for a in (x * x, y * y, x * y))
        # The direction of least spread, in closed form.
        angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        distance = np.abs((offset * normal[:, :, None]).sum(axis=-1))
        weight = (found & (distance <= _STRAY_PX)).astype(np.float64)
    enough = (found & (distance <= _STRAY_PX)).sum(axis=-1) >= _SAMPLES // 2
    return normal, (normal * centre).sum(axis=-1), enough
