"""A UR3 with a Robotiq gripper, through ur_rtde (in a process of its own, see ``ur_link``)."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from importlib.util import find_spec

import numpy as np

from eisp_data.errors import RobotError
from eisp_data.robots import ur_link
from eisp_data.robots.arms import get_arm, joint_limits
from eisp_data.robots.camera import OpenCvCamera
from eisp_data.robots.clock import HardwareClock
from eisp_data.robots.robot import CameraFrame, JointCommand, Reading, Robot
from eisp_data.robots.robotiq import RobotiqGripper

_CONNECT_S = 15.0
_SILENCE_S = 0.5
"""States come every 8 ms; after this long without one the connection is lost."""
_GOODBYE_S = 2.0

if find_spec("rtde_control") is None:
    raise ModuleNotFoundError("No module named 'ur_rtde'", name="ur_rtde")


class Ur3Robot(Robot):
    """A UR3 at an address, its gripper on the same controller, and a camera on this machine."""

    def __init__(
        self,
        host: str,
        camera: str | None = None,
        control_hz: float = 25.0,
    ) -> None:
        """Prepare; nothing is connected yet.

        Args:
            host: address of the controller.
            camera: what OpenCV opens as the camera ``top``, for instance ``0``; none if left out.
            control_hz: how often ``command`` will be called.
        """
        arm = get_arm("ur3")
        self.name, self.arm, self.joint_names = "ur3", arm.name, arm.joint_names
        self.control_hz, self.limits = control_hz, joint_limits(arm.name)
        self._devices = {} if camera is None else {"top": OpenCvCamera(camera)}
        self.cameras = {name: device.intrinsics for name, device in self._devices.items()}
        self._gripper = RobotiqGripper(host, arm.gripper_m[1])
        self._link = _Link(host, control_hz)
        self._clock = HardwareClock()

    def connect(self) -> None:
        """Connect to cameras, gripper and controller, in the order of how easily they fail."""
        try:
            for device in self._devices.values():
                device.open()
            self._gripper.connect()
            self._link.open()
        except RobotError:
            self.disconnect()
            raise

    def calibrate(self) -> None:
        """Activate the gripper, and open and close it once to find its range."""
        self._gripper.calibrate()

    def now_s(self) -> float:
        """Read this machine's monotonic clock."""
        return time.monotonic()

    def wait_until(self, robot_s: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, robot_s - time.monotonic()))

    def observe(self) -> Reading:
        """Return the newest reading of the 125 a second that the controller sends.

        The torques of a CB3 are not measured: ``joint_effort`` is None.
        """
        state, arrived_s = self._link.newest()
        return Reading(
            joint_position=np.array(state[1:7]),
            joint_velocity=np.array(state[7:13]),
            gripper_opening_m=self._gripper.opening_m(),
            hardware_s=self._clock.to_host_s(state[0], arrived_s),
        )

    def frames(self) -> dict[str, CameraFrame]:
        """Return each camera's newest frame."""
        return {name: device.frame() for name, device in self._devices.items()}

    def command(self, command: JointCommand) -> JointCommand:
        """Lead the arm to the targets within one control period."""
        self._link.newest()
        opening_m = self._gripper.move(command.gripper_opening_m)
        self._link.lead_to(np.asarray(command.joint_position, float))
        return JointCommand(command.joint_position, opening_m)

    def stop(self) -> None:
        """Slow down and stand still; a later command starts from there."""
        self._link.halt()

    def disconnect(self) -> None:
        """Stop the arm and end the program that runs on the controller."""
        self._link.close()
        self._gripper.disconnect()
        for device in self._devices.values():
            device.close()


class _Link:
    """Our end of the process that talks to the controller."""

    def __init__(self, host: str, control_hz: float) -> None:
        self._host, self._control_hz = host, control_hz
        self._process: subprocess.Popen[bytes] | None = None
        self._newest: tuple[tuple[float, ...], float] | None = None
        self._fault: str | None = None

    def open(self) -> None:
        """Start it and wait for the first state."""
        self._newest = self._fault = None
        self._process = subprocess.Popen(
            [sys.executable, "-m", ur_link.__name__, self._host, str(self._control_hz)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            # Ctrl-C and a closed terminal are for us: it still has to stop the arm.
            start_new_session=True,
        )
        threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
        until = time.monotonic() + _CONNECT_S
        while self._newest is None:
            if self._fault or time.monotonic() > until:
                self.close()
                raise RobotError(
                    f"no UR controller at {self._host}: {self._fault or 'it does not answer'}"
                )
            time.sleep(0.01)

    def newest(self) -> tuple[tuple[float, ...], float]:
        """Return the newest state and when it arrived; RobotError if the arm cannot move."""
        if self._process is None or self._newest is None:
            raise RobotError("ur3 is not connected")
        state, arrived_s = self._newest
        bits = int(state[13])
        silent = time.monotonic() - arrived_s > _SILENCE_S
        if self._fault or silent or not bits & ur_link.CONNECTED:
            raise RobotError(f"the connection to the UR controller at {self._host} is lost")
        if bits & ur_link.EMERGENCY_STOP:
            raise RobotError("the UR3 is in an emergency stop")
        if bits & ur_link.PROTECTIVE_STOP:
            raise RobotError("the UR3 is in a protective stop: clear it on the teach pendant")
        if bits & ur_link.REFUSED:
            raise RobotError("the UR3 refuses to move: its program has ended")
        return state, arrived_s

    def lead_to(self, target: np.ndarray) -> None:
        """Be at (6,) rad one control period from now."""
        self._send(b"L", ur_link.TARGET.pack(*target))

    def halt(self) -> None:
        """Slow down and stand still."""
        with contextlib.suppress(RobotError):
            self._send(b"H")

    def close(self) -> None:
        """End the process, by force if the connection is lost: the controller then stops alone."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(timeout=_GOODBYE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _send(self, kind: bytes, body: bytes = b"") -> None:
        if self._process is None:
            raise RobotError("ur3 is not connected")
        assert self._process.stdin is not None
        try:
            ur_link.write_frame(self._process.stdin, kind, body)
        except OSError:
            raise RobotError(
                f"the connection to the UR controller at {self._host} is lost"
            ) from None

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        while (frame := ur_link.read_frame(process.stdout)) is not None:
            kind, body = frame
            if kind == b"S":
                self._newest = ur_link.STATE.unpack(body), time.monotonic()
            else:
                self._fault = body.decode()
        self._fault = self._fault or "the connection was closed"
