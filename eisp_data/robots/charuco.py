"""The ChArUco board that the gripper holds while a cell is calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from eisp_data.robots.markers import facing

SQUARES = (5, 4)
SQUARE_M, MARKER_M = 0.032, 0.025
_DICTIONARY = "DICT_4X4_100"
_FIRST_ID = 50
"""The cell's own markers end before (``DICT_4X4_50``); these are of the same size in bits."""
_LEAST_CORNERS = 6


@dataclass(frozen=True)
class BoardView:
    """The board in one image."""

    points: np.ndarray
    """(N, 3) m, corners of its squares in its own frame."""
    pixels: np.ndarray
    """(N, 2) where they are seen."""


@cache
def board() -> Any:
    """Return OpenCV's board; its frame has its origin in a corner, x right, y down, z away."""
    import cv2

    count = SQUARES[0] * SQUARES[1] // 2
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _DICTIONARY))
    ids = np.arange(_FIRST_ID, _FIRST_ID + count)
    return cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, dictionary, ids)


def board_size() -> tuple[float, float]:
    """Return its width and height, m."""
    return SQUARES[0] * SQUARE_M, SQUARES[1] * SQUARE_M


def transform_sheet_to_tool() -> np.ndarray:
    """Return (4, 4): where the twin's gripper holds the middle of the board, facing the camera.

    The sheet's frame is as a marker's. Of a real board nothing need be known: where it is held is
    found along with the rest.
    """
    slope = np.sqrt(0.5)
    return facing((slope, 0, slope), (-slope, 0, slope), (0.065, 0.0, 0.05))


def board_picture(pixels_per_m: float) -> np.ndarray:
    """Return the board to be printed, (H, W) uint8."""
    width, height = (round(pixels_per_m * size) for size in board_size())
    return board().generateImage((width, height))


class BoardDetector:
    """Finds the board in images."""

    def __init__(self) -> None:
        import cv2

        self._detector = cv2.aruco.CharucoDetector(board())

    def detect(self, image: np.ndarray) -> BoardView | None:
        """Return the board in an (H, W, 3) uint8 RGB image, None if too little of it is seen."""
        import cv2

        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, numbers, _, _ = self._detector.detectBoard(grey)
        if numbers is None or len(numbers) < _LEAST_CORNERS:
            return None
        points = board().getChessboardCorners()[numbers.ravel()]
        return BoardView(points.astype(np.float64), corners[:, 0].astype(np.float64))
