"""The twin's camera: a pinhole picture by OpenGL, bent by a lens, with the noise of a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.robots import cell
from eisp_data.robots.robot import CameraIntrinsics
from eisp_data.sim.offscreen import Offscreen

CAMERA = "top"
"""Its name, in the scene and as one of the robot's cameras."""

_NOISE_BANK = 4_000_000
_BORDER_PX = 2
_SIZE_STEP = 16


@dataclass(frozen=True)
class CameraOptions:
    """What is not ideal about the camera."""

    rate_hz: float = 30.0
    latency_s: float = 0.03
    """From when the light falls on the sensor until the image can be had."""
    drop_probability: float = 0.0
    """Of each image, that it gets lost on its way."""
    noise_std: float = 2.0
    """Standard deviation of the noise, in grey levels of 255."""
    distortion: tuple[float, float, float, float, float] = (-0.06, 0.03, 5e-4, -3e-4, 0.0)
    """OpenCV's k1, k2, p1, p2, k3 of the lens."""
    mounting_error: float = 0.0
    """How far off its design the camera is mounted and made, as a multiple of 5 mm in each
    direction, 0.6 degrees about each axis and 0.5% of the focal length (standard deviations);
    drawn from the robot's seed. Calibration finds out."""

    def check(self) -> None:
        """Raise ConfigError for a value that makes no sense."""
        if not 0 < self.rate_hz <= 120:
            raise ConfigError(f"camera rate must be over 0 and at most 120 Hz; got {self.rate_hz}")
        if not 0 <= self.latency_s <= 1:
            raise ConfigError(f"camera latency must be 0 to 1 s; got {self.latency_s}")
        if not 0 <= self.drop_probability < 1:
            raise ConfigError(f"drop probability must be 0 to 1; got {self.drop_probability}")
        if not 0 <= self.noise_std <= 50:
            raise ConfigError(f"camera noise must be 0 to 50 grey levels; got {self.noise_std}")


@dataclass(frozen=True)
class MountedCamera:
    """A camera as it really is."""

    intrinsics: CameraIntrinsics
    transform_camera_to_task: np.ndarray
    """(4, 4)."""


def mount_camera(options: CameraOptions, rng: np.random.Generator) -> MountedCamera:
    """Return the camera of the design, off by what the options say."""
    import cv2

    width, height = cell.CAMERA_SIZE
    off = options.mounting_error * rng.normal(size=9)
    focal = cell.CAMERA_FOCAL_PX * (1 + 0.005 * off[6])
    centre = np.array([width - 1, height - 1]) / 2 + 4.0 * off[7:]
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    rotation, _ = cv2.Rodrigues(np.radians(0.6) * off[3:6])
    shift = cell.transform(rotation, 0.005 * off[:3])
    return MountedCamera(
        CameraIntrinsics(width, height, matrix, np.array(options.distortion)),
        cell.transform_camera_to_task() @ shift,
    )


def designed_intrinsics(options: CameraOptions) -> CameraIntrinsics:
    """Return the intrinsics of a camera without mounting error."""
    exact = CameraOptions(distortion=options.distortion)
    return mount_camera(exact, np.random.default_rng(0)).intrinsics


class Lens:
    """From a pinhole picture to that of a lens with distortion."""

    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        """Find out, for every pixel, where its light comes from.

        Attributes:
            size: (width, height) of the pinhole picture that has all that the lens sees.
        """
        import cv2

        width, height = intrinsics.width, intrinsics.height
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        rays = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2).astype(np.float64), intrinsics.matrix, intrinsics.distortion
        ).reshape(height, width, 2)
        self.focal_px = float(intrinsics.matrix[0, 0])
        reach = self.focal_px * np.abs(rays).max(axis=(0, 1)) + _BORDER_PX
        columns, rows = (2 * np.ceil(reach / (_SIZE_STEP / 2)) * (_SIZE_STEP / 2)).astype(int)
        self.size = (int(columns), int(rows))
        # OpenCV counts pixels from the middle of the first one.
        source = self.focal_px * rays + (np.array(self.size) - 1) / 2
        self._maps = cv2.convertMaps(
            source[..., 0].astype(np.float32), source[..., 1].astype(np.float32), cv2.CV_16SC2
        )

    def bend(self, picture: np.ndarray) -> np.ndarray:
        """Return the (H, W, 3) image of a (rows, columns, 3) pinhole picture."""
        import cv2

        return cv2.remap(picture, *self._maps, cv2.INTER_LINEAR)


class TwinCamera:
    """Takes pictures of a cell; belongs to the thread that made it."""

    def __init__(
        self,
        model: mujoco.MjModel,
        lens: Lens,
        options: CameraOptions,
        rng: np.random.Generator,
    ) -> None:
        """Open an OpenGL context; ConfigError if there is no OpenGL on this machine."""
        self._lens = lens
        width, height = lens.size
        self._model, self._data = model, mujoco.MjData(model)
        self._rng = rng
        self._noise = _noise_bank(options.noise_std, rng)
        self._offscreen = Offscreen(model, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 1)
        self._picture = np.empty((height, width, 3), np.uint8)

    def take(self, qpos: np.ndarray) -> np.ndarray:
        """Return the (H, W, 3) uint8 RGB image of the cell with its joints at (nq,)."""
        self._pose_scene(qpos)
        self._offscreen.draw(self._scene, self._picture)
        return self._with_noise(self._lens.bend(self._picture[::-1]))

    def close(self) -> None:
        """Free the OpenGL context."""
        self._offscreen.close()

    def _pose_scene(self, qpos: np.ndarray) -> None:
        model, data, scene = self._model, self._data, self._scene
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = model.camera(CAMERA).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, everything, scene)

    def _with_noise(self, image: np.ndarray) -> np.ndarray:
        import cv2

        if self._noise is None:
            return image
        start = int(self._rng.integers(len(self._noise) - image.size))
        noise = self._noise[start : start + image.size].reshape(image.shape)
        return cv2.add(image, noise, dtype=cv2.CV_8U)


def aim_camera(spec: mujoco.MjSpec, mounted: MountedCamera, lens: Lens) -> None:
    """Put a camera where the real one is, with a picture large enough for its lens."""
    width, height = lens.size
    pose = mounted.transform_camera_to_task
    quaternion = np.empty(4)
    # MuJoCo's cameras look along -z with y up.
    rotation = np.ascontiguousarray(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    spec.delete(spec.camera(CAMERA))
    upwards = 2 * np.degrees(np.arctan(height / 2 / lens.focal_px))
    spec.worldbody.add_camera(name=CAMERA, pos=pose[:3, 3], quat=quaternion, fovy=upwards)
    getattr(spec.visual, "global").offwidth = width
    getattr(spec.visual, "global").offheight = height


def _noise_bank(std: float, rng: np.random.Generator) -> np.ndarray | None:
    """Return noise to take slices from; drawing it anew would take longer than rendering."""
    if std == 0:
        return None
    return np.clip(np.round(rng.normal(0.0, std, _NOISE_BANK)), -127, 127).astype(np.int8)
