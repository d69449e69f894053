"""What a robot senses and is told, as an MCAP recording: each source at its own rate and time.

Stamps are those of the robot's clock, laid on the calendar once at the start, so that a recording
of a simulated robot has the same spacing however long the simulation took.

=========================  =============================  =======================================
topic                      message                        role in a dataset
=========================  =============================  =======================================
/joint_states              ``foxglove.JointStates``       extra: positions and velocities
/gripper                   ``eisp.Vector``                extra: the opening
/camera/<name>/image       ``foxglove.CompressedImage``   image
/joint_command             ``eisp.Vector``                extra: what was really sent
/action                    ``eisp.Vector``                action
/observation/...           ``eisp.Vector``                state, environment
/achieved_goal, ...        ``eisp.Vector``                achieved goal, desired goal
/subgoal                   ``eisp.Vector``                extra
/objects                   ``foxglove.FrameTransforms``   none: for people to look at
/events                    ``foxglove.Event``             events
=========================  =============================  =======================================
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from eisp_data.robots.estimates import Estimates, quaternion
from eisp_data.robots.robot import CameraFrame, JointCommand, Reading, Robot
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.writer import McapWriter, WriterStats

_OPENING, _TASK_FRAME = "gripper_opening_m", "task"
_NANOSECONDS = 1_000_000_000


class SessionLog:
    """Records one connected robot; to be closed, for only then the file has its index.

    Attributes:
        reading: the newest reading of the joints.
        frames: the newest image of each camera.
        lost_frames: by camera, how many images the camera took that never arrived here.
    """

    def __init__(
        self,
        robot: Robot,
        path: Path,
        metadata: Mapping[str, str],
        images: bool = True,
    ) -> None:
        """Create the file.

        Args:
            robot: connected.
            path: must not exist yet.
            metadata: describes the session.
            images: whether they are recorded; if not, those that nobody asks for are not taken.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self._robot, self._images = robot, images
        self._writer = McapWriter(path, metadata=metadata)
        # Whole microseconds, or rounding would part what has one stamp.
        self._epoch_ns = (self._writer.now_ns() - self._now_ns()) // 1000 * 1000
        self.reading: Reading = robot.observe()
        self.frames: dict[str, CameraFrame] = {}
        self.lost_frames: Counter[str] = Counter()
        self._log_reading(self.reading)

    def sense(self, looks: bool) -> None:
        """Take in what is new, and record it; RobotError if joints or cameras do not answer.

        ``looks`` says that images are needed now for more than the record.
        """
        reading = self._robot.observe()
        if reading.hardware_s > self.reading.hardware_s:
            self.reading = reading
            self._log_reading(reading)
        if self._images or looks:
            self._take_images()

    def _take_images(self) -> None:
        for name, frame in self._robot.frames().items():
            before = self.frames.get(name)
            if before is not None and frame.sequence == before.sequence:
                continue
            self.frames[name] = frame
            if self._images:
                if before is not None:
                    self.lost_frames[name] += max(0, frame.sequence - before.sequence - 1)
                at = self._stamp(frame.captured_s)
                self._writer.image(f"/camera/{name}/image", frame.image, at)

    def sent(self, command: JointCommand, at_ns: int) -> None:
        """Record what was sent to the joints at the tick ``at_ns`` of the robot's clock."""
        values = [*command.joint_position, command.gripper_opening_m]
        names = (*self._robot.joint_names, _OPENING)
        self.vector("/joint_command", values, at_ns, names, "extra.joint_command")

    def vector(
        self,
        topic: str,
        values: messages.Numbers,
        at_ns: int,
        names: Sequence[str] = (),
        role: str | None = None,
    ) -> None:
        """Record numbers of the tick ``at_ns`` of the robot's clock."""
        self._writer.vector(topic, values, self._epoch_ns + at_ns, names, role)

    def objects(self, estimates: Estimates, at_ns: int) -> None:
        """Record where things are believed to be at a tick, each with the time it was last seen."""
        poses, times = {}, {}
        for name, thing in estimates.objects.items():
            pose = thing.transform_object_to_task
            poses[name] = (pose[:3, 3], quaternion(pose[:3, :3]))
            times[name] = self._stamp(estimates.tool.time_s - thing.age_s)
        message = messages.transforms(poses, times, _TASK_FRAME)
        self._writer.log("/objects", message, self._epoch_ns + at_ns)

    def event(self, kind: str, at_ns: int, **details: object) -> None:
        """Record an event; see ``messages.EVENT_KINDS``."""
        self._writer.event(kind, self._epoch_ns + at_ns, **details)

    def close(self) -> WriterStats:
        """Write what is waiting, the index and the footer; DataError if the disk refuses."""
        return self._writer.close()

    def _log_reading(self, reading: Reading) -> None:
        at = self._stamp(reading.hardware_s)
        message = messages.joints(
            self._robot.joint_names,
            reading.joint_position,
            at,
            reading.joint_velocity,
            reading.joint_effort,
        )
        self._writer.log("/joint_states", message, at, "extra.joints")
        opening = [reading.gripper_opening_m]
        self._writer.vector("/gripper", opening, at, (_OPENING,), "extra.gripper")

    def _stamp(self, robot_s: float) -> int:
        return self._epoch_ns + round(robot_s * _NANOSECONDS)

    def _now_ns(self) -> int:
        return round(self._robot.now_s() * _NANOSECONDS)
