"""From images and joint readings to where everything is: the tracker of one cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.aruco import MarkerDetector
from eisp_data.robots.calibration import Calibration
from eisp_data.robots.estimates import Estimates, ObjectEstimate
from eisp_data.robots.kinematics import kinematics
from eisp_data.robots.markers import marked_objects
from eisp_data.robots.pose import PoseFit, Priors, View, fit_pose, fit_slide
from eisp_data.robots.robot import CameraFrame, Reading
from eisp_data.robots.tool_history import ToolHistory
from eisp_data.robots.tracks import HALF_M, BlockTrack, DrawerTrack
from eisp_data.sim.drawer import TRAY_CENTRE_M
from eisp_data.tasks.base import Task

_TILT_STD, _HEIGHT_STD_M = 0.01, 0.0007
"""Of a block that stands on something."""
_UPRIGHT_PX = 0.5
"""A block that fits better than this standing upright does so."""
_FLYING_PX = 0.35
"""A block that nothing holds and nothing carries has to fit as well as this."""
_ANY_TILT_STD = 0.5
"""Of one that does not: it only says which of two mirror images it is."""
_HELD_TILT_STD = 0.1
_UPRIGHT = 0.995
"""Cosine of the tilt from which on a block is on its way from one face to another."""
_STANDS_M, _STANDS_STD = 0.006, 3.0
"""How far off its place a standing block may seem: so far, and so many standard deviations."""
_STOOD_M = 0.003
"""A block is believed to stand that is this near to where it would."""
_SUNK_M = 0.01
"""A block may seem so far below what it stands on."""
_TRAY_HALF_M = (0.060, 0.070)
_UNKNOWN_IMAGES = 8
"""A marker has to be seen in so many images in a row to be one: now and then, for one or two, the
edges of arm, drawer and a covered marker make up the code of another."""
_MOVED_PX = 4.0
"""The table's markers so far off where the calibration has them mean that the camera moved."""
_OPENS = np.array([-1.0, 0.0, 0.0])


class Tracker:
    """Keeps track of the objects of a task."""

    def __init__(self, task: Task, calibration: Calibration, camera: str, arm: str) -> None:
        """Begin with nothing seen.

        Args:
            task: whose objects are on the table.
            calibration: of the cell.
            camera: which of its cameras to use.
            arm: a name of ``kinematics.ARMS``.
        """
        to_task = calibration.transform_base_to_task
        self._view = View(calibration.cameras[camera], to_task)
        self._tools = ToolHistory(kinematics(arm), to_task)
        self._detector = MarkerDetector()
        self._marked = marked_objects(task)
        self._known = {m.number for item in self._marked.values() for m in item.markers}
        self._blocks = {f"block{i}": BlockTrack() for i in range(task.blocks)}
        self._drawer = DrawerTrack() if task.fixtures else None
        self._sequence: int | None = None
        self._unknown: Counter[int] = Counter()
        self._off_px: float | None = None

    def update(self, reading: Reading, frame: CameraFrame | None = None) -> Estimates:
        """Take in a reading and, if it is a new one, an image; return what is believed now."""
        before = self._tools.newest if self._tools else None
        tool = self._tools.add(reading)
        before = before or tool
        was = None if self._drawer is None else self._drawer.opening_m
        inside = [(b, b.seen_s) for b in self._blocks.values() if self._in_tray(b.pose, was)]
        if frame is not None and frame.sequence != self._sequence:
            self._sequence = frame.sequence
            self._see(frame)
        if self._drawer is not None:
            self._drawer.follow(before.transform_tool_to_task, tool)
            way = (self._drawer.opening_m or 0.0) - (was or 0.0)
            for block, seen_s in inside:
                if block.seen_s == seen_s:  # else it is where the image showed it
                    block.shift(way * _OPENS)
        for name, block in self._blocks.items():
            block.follow(before, tool, partial(self._standing_height, name))
        return self.estimates()

    def estimates(self) -> Estimates:
        """Return what is believed at the time of the last reading."""
        tool = self._tools.newest
        objects = {}
        for name, block in self._blocks.items():
            if block.pose is not None:
                objects[name] = ObjectEstimate(
                    transform_object_to_task=block.pose,
                    velocity=block.velocity,
                    spin=block.spin,
                    age_s=tool.time_s - block.seen_s,
                    held=block.held,
                )
        if self._drawer is not None and self._drawer.opening_m is not None:
            pose = np.eye(4)
            pose[:3, 3] = self._drawer.opening_m * _OPENS
            objects["drawer"] = ObjectEstimate(
                transform_object_to_task=pose,
                velocity=self._drawer.speed_m_s * _OPENS,
                spin=np.zeros(3),
                age_s=tool.time_s - self._drawer.seen_s,
                held=False,
            )
        return Estimates(tool=tool, objects=objects)

    def missing(self) -> list[str]:
        """Return the objects that have not been seen yet, with the numbers of their markers."""
        names = [name for name, block in self._blocks.items() if block.pose is None]
        if self._drawer is not None and self._drawer.opening_m is None:
            names.append("drawer")
        numbers = {name: [str(m.number) for m in self._marked[name].markers] for name in names}
        return [f"{name} (markers {', '.join(numbers[name])})" for name in names]

    def check(self) -> None:
        """Raise RobotError where what the camera shows cannot be this cell.

        A marker of no object is in view, or the markers on the table are not where the calibration
        has them.
        """
        if self._off_px is not None and self._off_px > _MOVED_PX:
            raise RobotError(
                f"the table's markers are {self._off_px:.0f} pixels from where the calibration has "
                "them: the camera was moved, or this is the calibration of another cell; run "
                "eisp-calibrate"
            )
        strange = sorted(n for n, count in self._unknown.items() if count >= _UNKNOWN_IMAGES)
        if strange:
            raise RobotError(
                f"unknown marker {', '.join(map(str, strange))} in view; this task has markers "
                f"{', '.join(map(str, sorted(self._known)))}"
            )

    def _see(self, frame: CameraFrame) -> None:
        found = self._detector.detect(frame.image)
        strange = [n for n in found.numbers.tolist() if n not in self._known]
        self._unknown = Counter({n: self._unknown[n] + 1 for n in strange})
        rays = dict(zip(found.numbers.tolist(), self._view.undistort(found.corners), strict=True))
        corners = dict(zip(found.numbers.tolist(), found.corners, strict=True))
        self._watch_table(corners)
        then = self._tools.at(frame.captured_s)
        since = self._tools.since(frame.captured_s)
        if self._drawer is not None:
            guess = self._drawer.opening_m or 0.0
            slid = fit_slide(self._view, self._marked["drawer"], rays, _OPENS, guess)
            if slid is not None:
                self._drawer.see(slid[0], frame.captured_s, then, since)
        for name, block in self._blocks.items():
            expected = block.expected(frame.captured_s, then)
            fit = self._fit_block(name, block, rays, expected)
            if fit is not None:
                fit = self._taken_along(fit, frame.captured_s)
                block.see(fit, frame.captured_s, then, since)

    def _taken_along(self, fit: PoseFit, captured_s: float) -> PoseFit:
        """Return the pose of a block that an image shows, with what the drawer did to it since."""
        if self._drawer is None or self._drawer.opening_m is None:
            return fit
        was = self._drawer.at(captured_s)
        if not self._in_tray(fit.transform_object_to_task, was):
            return fit
        pose = fit.transform_object_to_task.copy()
        pose[:3, 3] += (self._drawer.opening_m - was) * _OPENS
        return replace(fit, transform_object_to_task=pose)

    def _fit_block(
        self,
        name: str,
        block: BlockTrack,
        rays: dict[int, np.ndarray],
        guess: np.ndarray | None,
    ) -> PoseFit | None:
        """Return the block's pose, with what is known of one that is held or stands."""
        item = self._marked[name]
        if block.held and guess is not None:
            held = fit_pose(self._view, item, rays, guess, Priors(_HELD_TILT_STD))
            return None if held is None or _on_another_face(held, guess) else held
        if guess is not None:
            unmoved = self._stand_as_before(name, guess, rays)
            if unmoved is not None:
                return unmoved
        fit = fit_pose(self._view, item, rays, guess, Priors(_TILT_STD))
        if fit is None or fit.error_px > _UPRIGHT_PX:
            tilted = fit_pose(self._view, item, rays, guess, Priors(_ANY_TILT_STD))
            # Freedom to tilt makes up for wrong corners, too: it has to explain much.
            if fit is None or (tilted is not None and tilted.error_px < 0.5 * fit.error_px):
                doubtful = tilted is None or _is_sunk(tilted) or _is_mirrored(tilted, guess)
                return None if doubtful else tilted
        standing = self._stand(name, fit, rays)
        if standing is not None:
            return standing
        if fit.transform_object_to_task[2, 3] > HALF_M and fit.error_px <= _FLYING_PX:
            return fit
        # Nothing sinks into the table, and hardly anything floats: sooner than that, a marker is
        # half covered, and another one alone tells more.
        rest = []
        for marker in item.markers:
            if marker.number in rays and len(item.markers) > 1:
                alone = {marker.number: rays[marker.number]}
                part = fit_pose(self._view, item, alone, guess, Priors(_TILT_STD))
                rest.append(None if part is None else self._stand(name, part, alone))
        return min(filter(None, rest), key=lambda part: part.error_px, default=None)

    def _stand_as_before(
        self, name: str, guess: np.ndarray, rays: dict[int, np.ndarray]
    ) -> PoseFit | None:
        """Return the pose of a block that stood and fits well on what it stood on, else None.

        That is so of most blocks in most images, and takes one fit instead of two.
        """
        heights = np.array([height + HALF_M for height in self._surfaces(name, guess)])
        off = np.abs(heights - guess[2, 3])
        if off.min() > _STOOD_M:
            return None
        priors = Priors(_TILT_STD, float(heights[off.argmin()]), _HEIGHT_STD_M)
        fit = fit_pose(self._view, self._marked[name], rays, guess, priors)
        return fit if fit is not None and fit.error_px < _FLYING_PX else None

    def _stand(self, name: str, fit: PoseFit, rays: dict[int, np.ndarray]) -> PoseFit | None:
        """Return the pose on what it stands on, None if it is not at the height of anything."""
        pose = fit.transform_object_to_task
        slack = max(_STANDS_M, _STANDS_STD * fit.position_std_m)
        heights = [height + HALF_M for height in self._surfaces(name, pose)]
        height = min(heights, key=lambda h: abs(h - pose[2, 3]))
        if abs(height - pose[2, 3]) > slack:
            return None
        priors = Priors(_TILT_STD, height, _HEIGHT_STD_M)
        standing = fit_pose(self._view, self._marked[name], rays, pose, priors)
        stands = standing is not None and standing.error_px < max(_UPRIGHT_PX, 1.5 * fit.error_px)
        return standing if stands else fit

    def _surfaces(self, name: str, pose: np.ndarray) -> list[float]:
        """Return the heights (m) of all that a block may stand on where it is."""
        heights = [0.0]
        if self._drawer is not None and self._in_tray(pose, self._drawer.opening_m):
            heights.append(TRAY_CENTRE_M[2] - HALF_M)
        for other, block in self._blocks.items():
            if other != name and block.pose is not None and not block.held:
                apart = np.abs(block.pose[:2, 3] - pose[:2, 3])
                if (apart < 1.8 * HALF_M).all():
                    heights.append(float(block.pose[2, 3]) + HALF_M)
        return heights

    def _standing_height(self, name: str, pose: np.ndarray) -> float:
        """Return the height at which a block stands if it is let go of at a pose (4, 4), metres."""
        heights = [height + HALF_M for height in self._surfaces(name, pose)]
        return max((h for h in heights if h < pose[2, 3] + _SUNK_M), default=HALF_M)

    def _in_tray(self, pose: np.ndarray | None, opening_m: float | None) -> bool:
        """Return whether a block at (4, 4) is in the drawer, if that is as far open."""
        if opening_m is None or pose is None:
            return False
        x, y, z = pose[:3, 3] - np.array(TRAY_CENTRE_M) - opening_m * _OPENS
        return abs(x) < _TRAY_HALF_M[0] and abs(y) < _TRAY_HALF_M[1] and abs(z) < 2 * HALF_M

    def _watch_table(self, corners: dict[int, np.ndarray]) -> None:
        """Note how far the table's markers are from where the calibration has them."""
        distances = [
            np.linalg.norm(self._view.project(marker.corners()) - corners[marker.number], axis=1)
            for marker in self._marked["table"].markers
            if marker.number in corners
        ]
        if distances:
            # The median: one that is half covered says nothing of the camera.
            off = float(np.median(np.concatenate(distances)))
            self._off_px = off if self._off_px is None else 0.7 * self._off_px + 0.3 * off


def _is_sunk(fit: PoseFit) -> bool:
    """Whether a block would be in the table, which on edge it is less than ever.

    So it seems where the arm covers a half of the only marker in sight.
    """
    return bool(fit.transform_object_to_task[2, 3] < HALF_M - _STANDS_M)


def _is_mirrored(fit: PoseFit, guess: np.ndarray | None) -> bool:
    """Whether a block would stand askew on another face than before.

    So it seems where the outline of the only marker in sight is wrong: of the two poses that it may
    have, the false one then fits better. From the camera a front that is a little off looks like a
    top that leans back.
    """
    if guess is None or not _on_another_face(fit, guess):
        return False
    return bool(np.abs(fit.transform_object_to_task[2, :3]).max() < _UPRIGHT)


def _on_another_face(fit: PoseFit, guess: np.ndarray) -> bool:
    """Whether another of a block's faces is up than in the guess (4, 4); in the fingers none is."""
    now, before = fit.transform_object_to_task[2, :3], guess[2, :3]
    face = np.abs(now).argmax()
    return bool(face != np.abs(before).argmax() or now[face] * before[face] < 0.0)
