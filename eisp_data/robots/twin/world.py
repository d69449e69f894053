"""The twin's physics and its time: servos follow targets, and the camera's moments are kept."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np

from eisp_data.robots import cell
from eisp_data.robots.robot import JointCommand, JointLimits, Reading
from eisp_data.robots.twin.arm import JOINTS, SERVO_LEAD_S
from eisp_data.robots.twin.camera import CameraOptions
from eisp_data.robots.twin.model import FINGERS, TIMESTEP_S
from eisp_data.sim.scene import CONTROL_HZ

_STOP_S = 0.15
_HALF_STEP_S = TIMESTEP_S / 2


@dataclass(frozen=True)
class Snapshot:
    """What stood before the camera when it took an image."""

    qpos: np.ndarray
    """(nq,)."""
    captured_s: float
    sequence: int


class World:
    """The cell in motion; it knows nothing of clocks or threads.

    Attributes:
        model, data: MuJoCo's.
        snapshots: the images that the camera took and nobody has asked for, oldest first.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        limits: JointLimits,
        camera: CameraOptions,
        rng: np.random.Generator,
    ) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        waiting = math.ceil(camera.latency_s * camera.rate_hz)
        self.snapshots: deque[Snapshot] = deque(maxlen=8 + waiting)
        self._limits, self._camera, self._rng = limits, camera, rng
        self._sequence = 0
        self._position = np.array([model.joint(name).qposadr[0] for name in JOINTS])
        self._velocity = np.array([model.joint(name).dofadr[0] for name in JOINTS])
        self._servos = np.array([model.actuator(name).id for name in JOINTS])
        self._fingers = np.array([model.joint(name).qposadr[0] for name in FINGERS])
        self._finger_speeds = np.array([model.joint(name).dofadr[0] for name in FINGERS])
        self._finger_servos = np.array([model.actuator(name).id for name in FINGERS])
        self.go_home()

    @property
    def time_s(self) -> float:
        """The simulated time."""
        return float(self.data.time)

    def go_home(self, opening_m: float | None = None) -> None:
        """Put the arm at rest in its home posture; the gripper as far open, else wholly."""
        opening = self._limits.gripper_m[1] if opening_m is None else opening_m
        self.data.qpos[self._position] = cell.HOME_RAD
        self.data.qpos[self._fingers] = opening / 2
        self.data.qvel[np.append(self._velocity, self._finger_speeds)] = 0.0
        self.data.ctrl[self._finger_servos] = opening / 2
        self._hold(np.array(cell.HOME_RAD))
        mujoco.mj_forward(self.model, self.data)

    def read(self) -> Reading:
        """Return what the joints say now."""
        data = self.data
        return Reading(
            joint_position=data.qpos[self._position].copy(),
            joint_velocity=data.qvel[self._velocity].copy(),
            gripper_opening_m=float(data.qpos[self._fingers].sum()),
            hardware_s=self.time_s,
            joint_effort=data.actuator_force[self._servos].copy(),
        )

    def command(self, command: JointCommand) -> JointCommand:
        """Follow the targets from now on, in a straight line over one control period.

        Targets beyond what the joints can do are cut to that; returns what is followed.
        """
        limits, period = self._limits, 1.0 / CONTROL_HZ
        start = self._target_at(self.time_s)
        reach = limits.velocity * period
        target = np.clip(command.joint_position, start - reach, start + reach)
        target = np.clip(target, limits.position_low, limits.position_high)
        opening = float(np.clip(command.gripper_opening_m, *limits.gripper_m))
        self._start, self._start_s = start, self.time_s
        self._target, self._target_s = target, self.time_s + period
        self.data.ctrl[self._finger_servos] = opening / 2
        return JointCommand(target, opening)

    def stop(self) -> None:
        """Come to rest on the way that the joints are on, and stay."""
        start = self._target_at(self.time_s)
        moving = self.data.qvel[self._velocity]
        self._start, self._start_s = start, self.time_s
        self._target = np.clip(
            start + moving * _STOP_S / 2, self._limits.position_low, self._limits.position_high
        )
        self._target_s = self.time_s + _STOP_S

    def advance_to(self, time_s: float) -> None:
        """Simulate until then."""
        data = self.data
        while data.time < time_s - _HALF_STEP_S:
            now = data.time + TIMESTEP_S
            target = self._target_at(now)
            ahead = (target - self._target_at(data.time)) / TIMESTEP_S * SERVO_LEAD_S
            data.ctrl[self._servos] = target + ahead
            mujoco.mj_step(self.model, data)
            self._look()

    def _look(self) -> None:
        """Keep this moment if the camera takes an image now, unless that gets lost."""
        captured = self._sequence / self._camera.rate_hz
        if self.data.time < captured - _HALF_STEP_S:
            return
        lost = self._camera.drop_probability
        if not lost or self._rng.random() >= lost:
            moment = Snapshot(self.data.qpos.copy(), self.time_s, self._sequence)
            self.snapshots.append(moment)
        self._sequence += 1

    def _hold(self, position: np.ndarray) -> None:
        self._start = self._target = position
        self._start_s = self._target_s = self.time_s
        self.data.ctrl[self._servos] = position

    def _target_at(self, time_s: float) -> np.ndarray:
        """Return where the joints should be then, (6,) rad."""
        span = self._target_s - self._start_s
        if span <= 0 or time_s >= self._target_s:
            return self._target
        return self._start + (time_s - self._start_s) / span * (self._target - self._start)
