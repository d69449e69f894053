"""``eisp-calibrate``: find the lens and the place of a cell's camera, and where the table is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eisp_data.cli.run import run
from eisp_data.config import at_least, check_seed
from eisp_data.errors import ConfigError
from eisp_data.robots.robot_config import RobotConfig, choose_camera, make_configured
from eisp_data.storage.files import check_writable


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig(RobotConfig):
    """Which cell, and how thoroughly."""

    output: Path
    """The calibration file to be written."""
    views: int = 30
    """Postures from which the board is shown."""
    seed: int = 0
    """Of the postures, and of the twin's mounting error."""
    twin_mounting_error: float = 1.0
    """How far the twin's camera is off its design (1 is some 5 mm and half a degree)."""


def main() -> None:
    """Run ``eisp-calibrate``."""
    run(calibrate, prog="eisp-calibrate")


def calibrate(config: CalibrateConfig) -> None:
    """Calibrate a cell: the gripper holds the ChArUco board and shows it to the camera.

    Nothing but its four markers may be on the table. docs/perception.md says what to print.
    """
    at_least(1, {"--views": config.views})
    check_seed(config.seed)
    if config.output.is_file():
        raise ConfigError(f"--output: {config.output} exists already; choose another, or remove it")
    check_writable(config.output, "--output")
    from tqdm import tqdm

    from eisp_data.robots.calibrate import calibrate_cell
    from eisp_data.robots.safe_robot import SafeRobot
    from eisp_data.robots.twin.camera import CameraOptions

    off = CameraOptions(mounting_error=config.twin_mounting_error)
    bare = make_configured(config, {"seed": config.seed, "camera": off, "board": True})
    with SafeRobot(bare) as robot:
        camera = choose_camera(config, robot)
        if camera is None:
            raise ConfigError(f"{robot.name} has no camera to calibrate: missing --camera-source")
        done = calibrate_cell(
            robot, camera, config.views, config.seed, lambda p: tqdm(p, "calibrating", unit="view")
        )
    done.save(config.output)
    quality = done.quality
    print(f"{config.output}: camera {camera!r} of {config.robot}")
    print(f"  reprojection error  {quality['reprojection_error_px']:.3f} pixels (root mean square)")
    print(f"  camera and joints   {quality['board_error_mm']:.2f} mm apart (median)")
    if hasattr(bare, "referee"):
        _judge(done, bare, camera)


def _judge(done: Any, robot: Any, camera: str) -> None:
    """Print how far off the twin's truth it is."""
    import numpy as np

    from eisp_data.robots.cell import transform_task_to_base

    true = transform_task_to_base() @ robot.referee.camera.transform_camera_to_task
    found = done.cameras[camera].transform_camera_to_base
    cosine = (np.trace(true[:3, :3].T @ found[:3, :3]) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    away = 1000 * np.linalg.norm(true[:3, 3] - found[:3, 3])
    table = 1000 * np.linalg.norm((done.transform_task_to_base - transform_task_to_base())[:3, 3])
    print(
        f"  off the truth       camera {away:.2f} mm and {angle:.3f} degrees, table {table:.2f} mm"
    )


if __name__ == "__main__":
    main()
