"""Which ArUco markers are stuck where: on the blocks, the drawer, the gripper and the table.

A marker's frame lies in its middle: x to its right and y to its top as one reads it, z out of it.
The frame of an object is the one whose pose the tasks speak of: a block's centre, the drawer when
closed (in the task's frame), the point between the fingertips, and the task's frame for the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from eisp_data.robots.cell import apply, transform
from eisp_data.sim.drawer import HANDLE_CLOSED_M, HANDLE_GAP_M
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.base import Task

DICTIONARY = "DICT_4X4_50"
"""Few bits, so that a bit is many pixels; 50 markers are enough for one table."""

BLOCK_MARKER_M = 0.042
"""As large as a face allows: what is left, 4 mm, has to stay light around the marker."""
GRIPPER_MARKER_M = 0.042
DRAWER_MARKER_M = 0.032
TABLE_MARKER_M = 0.044
RIM_M = 0.004
"""Light rim around every marker."""

_BLOCK_IDS, _GRIPPER_IDS, _DRAWER_IDS, _TABLE_IDS = 0, 24, 30, 40


@dataclass(frozen=True)
class Marker:
    """One marker on an object."""

    number: int
    """Its id in the dictionary."""
    size_m: float
    """Edge of its black square."""
    transform_marker_to_object: np.ndarray
    """(4, 4)."""

    def corners(self) -> np.ndarray:
        """Return its corners in the object's frame, (4, 3) m, clockwise from its top left one."""
        half = self.size_m / 2
        square = half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        return apply(self.transform_marker_to_object, square)


@dataclass(frozen=True)
class MarkedObject:
    """A rigid body with its markers."""

    name: str
    markers: tuple[Marker, ...]


def marked_objects(task: Task) -> dict[str, MarkedObject]:
    """Return what carries markers in the cell of a task: ``block0``..., ``drawer`` and the rest."""
    objects = [MarkedObject(f"block{i}", _on_block(i)) for i in range(task.blocks)]
    if task.fixtures:
        objects.append(MarkedObject("drawer", _in_drawer()))
    objects.append(MarkedObject("gripper", _on_gripper()))
    objects.append(table_markers())
    return {item.name: item for item in objects}


def table_markers() -> MarkedObject:
    """Return the table, whose frame is the task's."""
    return MarkedObject("table", _on_table())


def dictionary() -> Any:
    """Return OpenCV's dictionary."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))


def facing(normal: Any, up: Any, position: Any) -> np.ndarray:
    """Return the (4, 4) transform of a marker with that normal (z) and reading direction (y)."""
    z, y = np.array(normal, dtype=float), np.array(up, dtype=float)
    return transform(np.stack([np.cross(y, z), y, z], axis=1), np.array(position, dtype=float))


@cache
def _on_block(index: int) -> tuple[Marker, ...]:
    """One on each face, ids 6 * index to 6 * index + 5: top, bottom, then the sides."""
    half = BLOCK_SIZE_M / 2
    faces = (
        ((0, 0, 1), (1, 0, 0)),
        ((0, 0, -1), (1, 0, 0)),
        ((1, 0, 0), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1)),
        ((-1, 0, 0), (0, 0, 1)),
        ((0, -1, 0), (0, 0, 1)),
    )
    return tuple(
        Marker(
            _BLOCK_IDS + 6 * index + face,
            BLOCK_MARKER_M,
            facing(normal, up, half * np.array(normal)),
        )
        for face, (normal, up) in enumerate(faces)
    )


@cache
def _in_drawer() -> tuple[Marker, ...]:
    """Return those on the inside of the front and on the tray's floor, left and right.

    The camera is opposite the arm and sees the inside of the front; neither a block in the tray nor
    the gripper at the handle hides all of them.
    """
    inside = HANDLE_CLOSED_M[0] + HANDLE_GAP_M + 0.012
    places = [((1, 0, 0), (0, 0, 1), (inside, side * 0.049, 0.030)) for side in (-1, 1)] + [
        ((0, 0, 1), (-1, 0, 0), (inside + depth, side * 0.048, 0.010))
        for depth in (0.024, 0.070)
        for side in (-1, 1)
    ]
    return tuple(
        Marker(_DRAWER_IDS + i, DRAWER_MARKER_M, facing(*place)) for i, place in enumerate(places)
    )


@cache
def _on_gripper() -> tuple[Marker, ...]:
    """One on a plate before the gripper, which leans back to face the camera."""
    slope = np.sqrt(0.5)
    return (
        Marker(
            _GRIPPER_IDS,
            GRIPPER_MARKER_M,
            facing((slope, 0, slope), (-slope, 0, slope), (0.036, 0, 0.112)),
        ),
    )


@cache
def _on_table() -> tuple[Marker, ...]:
    """Four around the workspace: they tell whether the camera is where it was calibrated."""
    places = ((0.15, 0.27), (0.15, -0.27), (0.46, 0.235), (0.46, -0.235))
    return tuple(
        Marker(_TABLE_IDS + i, TABLE_MARKER_M, facing((0, 0, 1), (-1, 0, 0), (x, y, 0.0005)))
        for i, (x, y) in enumerate(places)
    )
