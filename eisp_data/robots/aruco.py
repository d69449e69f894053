"""Markers in an image: found by OpenCV, their corners then fitted to the edges of the print.

OpenCV's own refinements leave some 0.3 pixels (measured in the twin at 45 pixels a marker); lines
through the edges, which use all of the outline, leave a third of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.robots.markers import dictionary

_LEAST_PERIMETER = 0.06
"""Of the image's longer side: 10 pixels an edge, less than what a code can be read from."""
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
_RIM_SHARE = 0.15
"""Of a marker's size, within which a rim around it ends. A rim in the shade is darker than the
table, and then OpenCV finds its outline instead of the marker's."""
_RIM_SAMPLES, _RIM_PLACES = 12, 6
"""Across and along an edge."""
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
        settings.minMarkerPerimeterRate = _LEAST_PERIMETER
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
    corners = _without_rim(grey, corners)
    points, found = _edge_points(grey, corners)
    normals, offsets, good = _fit_lines(points, found)
    fitted, crossing = _crossings(normals, offsets)
    near = np.linalg.norm(fitted - corners, axis=-1) <= 2 * _REACH_PX
    good = good & np.roll(good, 1, axis=1) & crossing & near
    return np.where(good[..., None], fitted, corners)


def _crossings(normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each of four lines crosses the one before it, (M, 4, 2), and whether it does.

    Args:
        normals: (M, 4, 2), of length 1.
        offsets: (M, 4), of the lines from the origin along them.
    """
    before_n, before_o = np.roll(normals, 1, axis=1), np.roll(offsets, 1, axis=1)
    cross = before_n[..., 0] * normals[..., 1] - before_n[..., 1] * normals[..., 0]
    crossing = np.abs(cross) > 0.1
    cross = np.where(crossing, cross, 1.0)
    x = (before_o * normals[..., 1] - offsets * before_n[..., 1]) / cross
    y = (before_n[..., 0] * offsets - normals[..., 0] * before_o) / cross
    return np.stack([x, y], axis=-1), crossing


def _without_rim(grey: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the corners (M, 4, 2), those of edges that are a rim's brought in to the marker's."""
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    size = (np.roll(length, 1, axis=1) + np.roll(length, -1, axis=1)) / 2
    # Outwards as far as the fine search goes, inwards as far as a rim may be wide.
    inwards = _REACH_PX + _RIM_SHARE * size
    across = _REACH_PX - inwards[..., None] * np.linspace(1.0, 0.0, _RIM_SAMPLES)
    places, outward, profile = _profiles(grey, corners, _RIM_PLACES, across)
    rise = np.diff(profile.mean(axis=2), axis=-1)
    steepest = rise.argmax(axis=-1)[..., None]
    middle = (across[..., 1:] + across[..., :-1]) / 2
    shift = np.take_along_axis(middle, steepest, axis=-1)[..., 0]
    shift = np.where((shift < -_REACH_PX) & (rise.max(axis=-1) > _FAINT), shift, 0.0)
    if not shift.any():
        return corners
    moved, crossing = _crossings(outward, (places[:, :, 0] * outward).sum(axis=-1) + shift)
    return np.where(crossing[..., None], moved, corners)


def _edge_points(grey: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (M, 4, S, 2) on the four edges of each marker, and which were found."""
    across = np.linspace(-_REACH_PX, _REACH_PX, _PROFILE)
    places, outward, profile = _profiles(
        grey, corners, _SAMPLES, np.broadcast_to(across, (*corners.shape[:2], _PROFILE))
    )
    # Dark inside, light outside.
    rise = np.clip(np.diff(profile, axis=-1), 0.0, None)
    middle = (across[1:] + across[:-1]) / 2
    steepest = rise.argmax(axis=-1)[..., None]
    rise[np.abs(np.arange(_PROFILE - 1) - steepest) > _PEAK] = 0.0
    total = rise.sum(axis=-1)
    shift = (rise * middle).sum(axis=-1) / np.maximum(total, 1e-9)
    return places + outward[:, :, None] * shift[..., None], total > _FAINT


def _profiles(
    grey: np.ndarray, corners: np.ndarray, count: int, across: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the grey levels across the four edges of each marker.

    Args:
        grey: (H, W) uint8.
        corners: (M, 4, 2) px.
        count: S places along each edge.
        across: (M, 4, P) px, outwards from the edge.

    Returns:
        The places (M, 4, S, 2) px, the edges' outward normals (M, 4, 2), the levels (M, 4, S, P).
    """
    import cv2

    way = np.roll(corners, -1, axis=1) - corners
    along = way / np.linalg.norm(way, axis=-1, keepdims=True)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    share = np.linspace(_FIRST, _LAST, count)
    places = corners[:, :, None] + way[:, :, None] * share[:, None]
    shifts = outward[:, :, None, None] * across[:, :, None, :, None]
    pixels = (places[:, :, :, None] + shifts).astype(np.float32)
    levels = cv2.remap(
        grey, pixels[..., 0].reshape(-1, 1), pixels[..., 1].reshape(-1, 1), cv2.INTER_LINEAR
    )
    return places, outward, levels.reshape(pixels.shape[:-1]).astype(np.float64)


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
