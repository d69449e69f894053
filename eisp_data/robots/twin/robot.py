"""The twin: a simulated UR3 cell behind the interface of a real one.

It is driven through joint commands and perceived through its camera and its joints. Whoever judges
it looks at its ``referee``.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import mujoco
import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots.arms import joint_limits
from eisp_data.robots.calibration import Calibration, designed
from eisp_data.robots.robot import CameraFrame, JointCommand, Reading, Robot
from eisp_data.robots.twin.arm import JOINTS
from eisp_data.robots.twin.camera import (
    CAMERA,
    CameraOptions,
    Lens,
    MountedCamera,
    TwinCamera,
    aim_camera,
    designed_intrinsics,
    mount_camera,
)
from eisp_data.robots.twin.eye import LazyEye, ThreadEye
from eisp_data.robots.twin.model import cell_spec
from eisp_data.robots.twin.referee import Referee
from eisp_data.robots.twin.world import Snapshot, World
from eisp_data.sim.scene import CONTROL_HZ, FINGER_TRAVEL_M
from eisp_data.tasks.registry import get_task

_GRIPPER_SPEED_M_S = 0.5
"""Of the servos of the task's scene; the fingers of a policy that was trained there."""


class TwinRobot(Robot):
    """A UR3 with a two-finger gripper before the table of a task.

    Attributes:
        calibration: of the cell as it was designed; right unless there is a mounting error.
        referee: the truth, for evaluation only.
    """

    name = "twin"
    arm = "ur3"
    joint_names = JOINTS
    control_hz = float(CONTROL_HZ)

    def __init__(
        self,
        task: str = "stack",
        *,
        realtime: bool = False,
        seed: int = 0,
        camera: CameraOptions | None = None,
        board: bool = False,
    ) -> None:
        """Build the cell; its objects stand where the task's start of that seed has them.

        Args:
            task: a name of ``eisp_data.tasks.registry``.
            realtime: whether its clock is the wall's; else it stands still but for ``wait_until``.
            seed: of the start, and of all noise.
            camera: what is not ideal about the camera.
            board: whether the gripper holds the calibration board.

        Raises:
            ConfigError: no such task, a bad option, or the ``robot`` extra is not installed.
        """
        options = CameraOptions() if camera is None else camera
        options.check()
        self.task = get_task(task)
        self.limits = replace(
            joint_limits("ur3"),
            gripper_m=(0.0, 2 * FINGER_TRAVEL_M),
            gripper_speed_m_s=_GRIPPER_SPEED_M_S,
        )
        factory = designed_intrinsics(options)
        self.cameras = {CAMERA: factory}
        self.calibration: Calibration = designed(self.name, CAMERA, factory)
        mounting, self._rng = (np.random.default_rng([seed, stream]) for stream in (1, 2))
        mounted = mount_camera(options, mounting)
        self._lens = Lens(mounted.intrinsics)
        self._options, self._realtime = options, realtime
        self._model = self._build(mounted, board)
        self._world = World(self._model, self.limits, options, self._rng)
        self._lock = threading.RLock()
        self._eye: LazyEye | ThreadEye | None = None
        self._origin_s = 0.0
        self.referee = Referee(self.task, self._world, mounted, self._lock)
        self.referee.reset(seed)
        if board:
            self.referee.clear_table()

    def connect(self) -> None:
        """Start the clock and the camera; ConfigError if there is no OpenGL on this machine."""
        if self._eye is not None:
            return
        self._origin_s = time.perf_counter() - self._world.time_s
        latency = self._options.latency_s
        if self._realtime:
            period = 1.0 / self._options.rate_hz
            self._eye = ThreadEye(
                self._open_camera, self._snapshots, self.wait_until, period, latency
            )
        else:
            self._eye = LazyEye(self._open_camera, self._world, latency)

    def now_s(self) -> float:
        """Read the wall's clock if it runs in real time, else the simulated time."""
        return time.perf_counter() - self._origin_s if self._realtime else self._world.time_s

    def wait_until(self, robot_s: float) -> None:
        """Sleep until then, or simulate until then."""
        if self._realtime:
            time.sleep(max(0.0, robot_s - self.now_s()))
        else:
            with self._lock:
                self._world.advance_to(robot_s)

    def observe(self) -> Reading:
        """Return what the joints say now; RobotError if the connection is lost."""
        self._check_arm()
        with self._lock:
            self._catch_up()
            return self._world.read()

    def frames(self) -> dict[str, CameraFrame]:
        """Return the newest image of the camera; RobotError if it is unplugged."""
        if self._eye is None:
            raise RobotError("the twin is not connected")
        if self.referee.unplugged_camera:
            raise RobotError(f"camera {CAMERA!r} of the twin is unplugged")
        frame = self._eye.newest(self.now_s())
        return {} if frame is None else {CAMERA: frame}

    def command(self, command: JointCommand) -> JointCommand:
        """Move towards the targets, as fast as the joints can; return what they are to follow.

        Raises:
            RobotError: the connection is lost, or the targets are not six finite angles and an
                opening.
        """
        self._check_arm()
        position = np.asarray(command.joint_position, dtype=np.float64)
        if position.shape != (len(JOINTS),) or not np.isfinite(position).all():
            raise RobotError(f"the twin takes {len(JOINTS)} finite joint angles; got {position}")
        if not np.isfinite(command.gripper_opening_m):
            raise RobotError(f"the gripper takes a finite opening; got {command.gripper_opening_m}")
        with self._lock:
            self._catch_up()
            return self._world.command(command)

    def stop(self) -> None:
        """Come to a stop as fast as is smooth, and stay."""
        with self._lock:
            if self._eye is not None:
                self._catch_up()
            self._world.stop()

    def disconnect(self) -> None:
        """Stop, and close the camera."""
        if self._eye is not None:
            self.stop()
            self._eye.close()
            self._eye = None

    def _build(self, mounted: MountedCamera, board: bool) -> mujoco.MjModel:
        spec = cell_spec(self.task, board)
        aim_camera(spec, mounted, self._lens)
        return spec.compile()

    def _open_camera(self) -> TwinCamera:
        return TwinCamera(self._model, self._lens, self._options, self._rng)

    def _check_arm(self) -> None:
        if self._eye is None:
            raise RobotError("the twin is not connected")
        if self.referee.unplugged_arm:
            raise RobotError("the connection to the twin's arm is lost")

    def _catch_up(self) -> None:
        if self._realtime:
            self._world.advance_to(self.now_s())

    def _snapshots(self, until_s: float) -> list[Snapshot]:
        with self._lock:
            self._world.advance_to(max(until_s, self.now_s()))
            taken = list(self._world.snapshots)
            self._world.snapshots.clear()
            return taken
