"""What a cell's calibration file says: its cameras, and where everything is to the arm's base."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.config import load_yaml, save_yaml
from eisp_data.errors import ConfigError
from eisp_data.robots import cell
from eisp_data.robots.arms import get_arm
from eisp_data.robots.robot import CameraIntrinsics, Robot

_ORTHONORMAL = 1e-4
"""How far a rotation in a file may be from one: its entries are written with nine digits."""
_SAME_TOOL = 1e-6


@dataclass(frozen=True)
class CameraCalibration:
    """One camera."""

    intrinsics: CameraIntrinsics
    transform_camera_to_base: np.ndarray
    """(4, 4)."""


@dataclass(frozen=True)
class Calibration:
    """Where things are in one cell. Transforms are (4, 4); see ``eisp_data.robots.cell``."""

    robot: str
    """A name in the registry."""
    cameras: dict[str, CameraCalibration]
    transform_task_to_base: np.ndarray
    transform_tool_to_flange: np.ndarray
    """The arm's own: what moves the arm knows no other."""
    quality: dict[str, float] = field(default_factory=dict)
    """What the calibration said about its own accuracy; for people to read."""

    @property
    def transform_base_to_task(self) -> np.ndarray:
        """(4, 4)."""
        return cell.inverse(self.transform_task_to_base)

    def save(self, path: Path) -> None:
        """Write the file; ConfigError says why it cannot."""
        try:
            save_yaml(_to_file(self), path)
        except OSError as error:
            raise ConfigError(f"cannot write the calibration {path}: {error.strerror}") from None

    def check(self, robot: Robot) -> None:
        """Raise ConfigError where this cannot be the calibration of that robot's cell."""
        if self.robot != robot.name:
            raise ConfigError(f"the calibration is of robot {self.robot!r}, not of {robot.name!r}")
        found, tool = self.transform_tool_to_flange, get_arm(robot.arm).transform_tool_to_tip
        if not np.allclose(found, tool, rtol=0, atol=_SAME_TOOL):
            raise ConfigError(
                f"the calibration's transform_tool_to_flange is {_listed(found)}, "
                f"but that of {robot.arm} is {_listed(tool)}"
            )
        for name, camera in robot.cameras.items():
            if name not in self.cameras:
                known = ", ".join(self.cameras) or "none"
                raise ConfigError(f"the calibration has no camera {name!r}; it has {known}")
            own = self.cameras[name].intrinsics
            if (own.width, own.height) != (camera.width, camera.height):
                raise ConfigError(
                    f"the calibration of camera {name!r} is for {own.width}x{own.height} pixels, "
                    f"but the camera gives {camera.width}x{camera.height}"
                )


def designed(robot: str, camera: str, intrinsics: CameraIntrinsics) -> Calibration:
    """Return the calibration of a cell that stands exactly as it was designed."""
    task, tool = cell.transform_task_to_base(), cell.transform_tool_to_flange()
    placed = CameraCalibration(intrinsics, task @ cell.transform_camera_to_task())
    return Calibration(robot, {camera: placed}, task, tool)


def usual(robot: Robot) -> Calibration:
    """Return what holds without a file: no camera, and the table at the arm's usual place."""
    arm = get_arm(robot.arm)
    return Calibration(robot.name, {}, arm.transform_task_to_base, arm.transform_tool_to_tip)


def load_calibration(path: Path) -> Calibration:
    """Read a file that ``Calibration.save`` wrote.

    Raises:
        ConfigError: there is no such file, or it is no calibration; the text names the key.
    """
    plain = load_yaml(_File, path)
    try:
        cameras = {
            name: CameraCalibration(
                CameraIntrinsics(
                    width=item.width,
                    height=item.height,
                    matrix=_array(item.matrix, (3, 3), f"cameras.{name}.matrix"),
                    distortion=_array(item.distortion, (5,), f"cameras.{name}.distortion"),
                ),
                _rigid(item.transform_camera_to_base, f"cameras.{name}.transform_camera_to_base"),
            )
            for name, item in plain.cameras.items()
        }
        return Calibration(
            robot=plain.robot,
            cameras=cameras,
            transform_task_to_base=_rigid(plain.transform_task_to_base, "transform_task_to_base"),
            transform_tool_to_flange=_rigid(
                plain.transform_tool_to_flange, "transform_tool_to_flange"
            ),
            quality=plain.quality,
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


@dataclass(frozen=True)
class _CameraInFile:
    width: int
    height: int
    matrix: list[list[float]]
    distortion: list[float]
    transform_camera_to_base: list[list[float]]


@dataclass(frozen=True)
class _File:
    robot: str
    cameras: dict[str, _CameraInFile]
    transform_task_to_base: list[list[float]]
    transform_tool_to_flange: list[list[float]]
    quality: dict[str, float]


def _to_file(calibration: Calibration) -> _File:
    return _File(
        robot=calibration.robot,
        cameras={
            name: _CameraInFile(
                width=camera.intrinsics.width,
                height=camera.intrinsics.height,
                matrix=_listed(camera.intrinsics.matrix),
                distortion=_listed(camera.intrinsics.distortion),
                transform_camera_to_base=_listed(camera.transform_camera_to_base),
            )
            for name, camera in calibration.cameras.items()
        },
        transform_task_to_base=_listed(calibration.transform_task_to_base),
        transform_tool_to_flange=_listed(calibration.transform_tool_to_flange),
        quality=calibration.quality,
    )


def _listed(array: np.ndarray) -> Any:
    return np.round(array, 9).tolist()


def _array(plain: list[Any], shape: tuple[int, ...], key: str) -> np.ndarray:
    try:
        array = np.array(plain, dtype=np.float64)
    except ValueError:
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise ConfigError(f"{key}: expected {'x'.join(map(str, shape))} finite numbers")
    return array


def _rigid(plain: list[Any], key: str) -> np.ndarray:
    array = _array(plain, (4, 4), key)
    rotation = array[:3, :3]
    square = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ORTHONORMAL
    if not (square and np.linalg.det(rotation) > 0 and (array[3] == [0, 0, 0, 1]).all()):
        raise ConfigError(f"{key}: expected a rotation and a translation")
    return array
