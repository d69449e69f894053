"""One arm of a TIAGo++ through rosbridge: ``ros_control`` trajectories out, joint states in.

The trajectory controller interpolates to the one point it is sent and stops there by itself: behind
a policy that falls silent the robot stands still.
"""

from __future__ import annotations

import base64
import binascii
import time
from typing import Any

import numpy as np

from eisp_data.errors import ConfigError, RobotError
from eisp_data.robots.arms import get_arm, joint_limits
from eisp_data.robots.clock import HardwareClock
from eisp_data.robots.robot import (
    CameraFrame,
    CameraIntrinsics,
    JointCommand,
    Reading,
    Robot,
)
from eisp_data.robots.rosbridge import Rosbridge

_JOINT_STATES = "/joint_states"
_TRAJECTORY = "trajectory_msgs/JointTrajectory"
_SILENCE_S = 1.0


class TiagoRobot(Robot):
    """The left or the right arm with its parallel gripper; torso and other arm stay as they are."""

    def __init__(
        self,
        host: str,
        side: str = "left",
        camera: str | None = None,
        control_hz: float = 25.0,
    ) -> None:
        """Prepare; nothing is connected yet.

        Args:
            host: of the rosbridge server, with or without ``:port``.
            side: ``left`` or ``right``.
            camera: topic of the camera ``top``, a ``sensor_msgs/CompressedImage`` with the
                ``camera_info`` of its driver beside it; none if left out.
            control_hz: how often ``command`` will be called.

        Raises:
            ConfigError: no such side.
        """
        if side not in ("left", "right"):
            raise ConfigError(f"unknown side {side!r} of TIAGo++; choose left or right")
        arm = get_arm(f"tiago_{side}")
        self.name, self.arm, self.joint_names = "tiago", arm.name, arm.joint_names
        self.control_hz, self.limits = control_hz, joint_limits(arm.name)
        self._topics = {} if camera is None else {"top": camera}
        self.cameras: dict[str, CameraIntrinsics] = {}
        self._fingers = [f"gripper_{side}_{finger}_finger_joint" for finger in ("left", "right")]
        self._arm_topic = f"/arm_{side}_controller/command"
        self._gripper_topic = f"/gripper_{side}_controller/command"
        self._ros = Rosbridge(host)
        self._clocks: dict[str, HardwareClock] = {}

    def connect(self) -> None:
        """Connect, and see that the arm's joints are among those that are published."""
        self._clocks.clear()
        try:
            self._ros.connect()
            self._ros.subscribe(_JOINT_STATES, "sensor_msgs/JointState")
            for topic in (self._arm_topic, self._gripper_topic):
                self._ros.advertise(topic, _TRAJECTORY)
            self._ros.wait_for(_JOINT_STATES)
            self.observe()
            for name, topic in self._topics.items():
                self.cameras[name] = self._open_camera(topic)
        except RobotError:
            self.disconnect()
            raise

    def now_s(self) -> float:
        """Read this machine's monotonic clock."""
        return time.monotonic()

    def wait_until(self, robot_s: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, robot_s - time.monotonic()))

    def observe(self) -> Reading:
        """Return the newest joint state."""
        found = self._ros.newest(_JOINT_STATES)
        if found is None:
            raise RobotError(f"nothing was published on {_JOINT_STATES} yet")
        message, arrived_s, _ = found
        columns = {name: i for i, name in enumerate(message["name"])}
        missing = [name for name in (*self.joint_names, *self._fingers) if name not in columns]
        if missing:
            raise RobotError(f"{_JOINT_STATES} has no {missing[0]}: this is another robot")
        arm = [columns[name] for name in self.joint_names]
        fingers = [message["position"][columns[name]] for name in self._fingers]
        effort = message.get("effort") or None
        return Reading(
            joint_position=np.array(message["position"], float)[arm],
            joint_velocity=np.array(message["velocity"], float)[arm],
            gripper_opening_m=float(sum(fingers)),
            hardware_s=self._stamp_s(_JOINT_STATES, message, arrived_s),
            joint_effort=None if effort is None else np.array(effort, float)[arm],
        )

    def frames(self) -> dict[str, CameraFrame]:
        """Return each camera's newest frame."""
        return {name: self._frame(name, topic) for name, topic in self._topics.items()}

    def command(self, command: JointCommand) -> JointCommand:
        """Send arm and gripper to the targets within one control period."""
        self._ros.newest(_JOINT_STATES)
        joints = np.asarray(command.joint_position, float).tolist()
        self._ros.publish(self._arm_topic, self._trajectory(self.joint_names, joints))
        half = float(command.gripper_opening_m) / 2.0
        self._ros.publish(self._gripper_topic, self._trajectory(self._fingers, [half, half]))
        return command

    def stop(self) -> None:
        """Tell the controllers to hold: an empty trajectory ends the one that is under way."""
        try:
            self._ros.publish(self._arm_topic, {"joint_names": list(self.joint_names)})
            self._ros.publish(self._gripper_topic, {"joint_names": self._fingers})
        except RobotError:
            # Without a connection there is nothing under way: a trajectory lasts one period.
            return

    def disconnect(self) -> None:
        """Stop and close."""
        self.stop()
        self._ros.disconnect()

    def _trajectory(self, names, positions: list[float]) -> dict[str, Any]:
        seconds = 1.0 / self.control_hz
        duration = {"secs": int(seconds), "nsecs": round(seconds % 1.0 * 1e9)}
        point = {"positions": positions, "time_from_start": duration}
        return {"joint_names": list(names), "points": [point]}

    def _open_camera(self, topic: str) -> CameraIntrinsics:
        """Subscribe to a camera's images, once it has said what it is."""
        # /top/image_raw/compressed is described by /top/camera_info.
        about = topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
        self._ros.subscribe(about, "sensor_msgs/CameraInfo")
        self._ros.subscribe(topic, "sensor_msgs/CompressedImage")
        info = self._ros.wait_for(about)
        self._ros.wait_for(topic)
        # ROS 1 says K and D, ROS 2 k and d.
        matrix, distortion = (info[key if key in info else key.lower()] for key in "KD")
        five = np.zeros(5)
        five[: len(distortion[:5])] = distortion[:5]
        return CameraIntrinsics(
            info["width"], info["height"], np.array(matrix, float).reshape(3, 3), five
        )

    def _frame(self, name: str, topic: str) -> CameraFrame:
        import cv2

        found = self._ros.newest(topic)
        if found is None or time.monotonic() - found[1] > _SILENCE_S:
            raise RobotError(f"camera {name!r} ({topic}) is unplugged")
        message, arrived_s, number = found
        try:
            data = np.frombuffer(base64.b64decode(message["data"], validate=True), np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        except (binascii.Error, cv2.error):
            image = None
        wanted = (self.cameras[name].height, self.cameras[name].width, 3)
        if image is None or image.shape != wanted:
            shape = "no image" if image is None else f"{image.shape[1]}x{image.shape[0]} pixels"
            raise RobotError(f"camera {name!r} gives {shape}; {wanted[1]}x{wanted[0]} is wanted")
        return CameraFrame(
            image=cv2.cvtColor(image, cv2.COLOR_BGR2RGB),
            captured_s=self._stamp_s(topic, message, arrived_s),
            sequence=int(message["header"].get("seq", number)),
        )

    def _stamp_s(self, topic: str, message: dict[str, Any], arrived_s: float) -> float:
        stamp = message["header"]["stamp"]
        # ROS 1 says secs and nsecs, ROS 2 sec and nanosec.
        seconds = stamp.get("secs", stamp.get("sec", 0))
        nanoseconds = stamp.get("nsecs", stamp.get("nanosec", 0))
        clock = self._clocks.setdefault(topic, HardwareClock())
        return clock.to_host_s(seconds + nanoseconds * 1e-9, arrived_s)
