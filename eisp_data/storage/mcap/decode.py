"""Messages of either world, Foxglove's protobuf or ROS 2's CDR, decoded into the same few shapes.

The payload of a damaged or foreign file may be anything, and the libraries that parse it raise
anything: every failure becomes a DataError that names the channel and the type.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from eisp_data.errors import DataError
from eisp_data.storage.mcap import messages


@dataclass(frozen=True)
class Joints:
    """Readings of J joints: (J,) float64 each, None where a message does not carry them."""

    time_ns: int | None
    names: tuple[str, ...]
    position: np.ndarray | None
    velocity: np.ndarray | None
    effort: np.ndarray | None


@dataclass(frozen=True)
class Pose:
    """Where ``child`` is in ``parent``: position (3,) m, quaternion (4,) wxyz."""

    time_ns: int | None
    parent: str
    child: str
    position: np.ndarray
    orientation: np.ndarray


@dataclass(frozen=True)
class Poses:
    """The poses of one message; a single pose has an empty child."""

    poses: tuple[Pose, ...]


@dataclass(frozen=True)
class Vector:
    """Numbers, (D,) float64, with D names or none."""

    time_ns: int | None
    names: tuple[str, ...]
    values: np.ndarray


@dataclass(frozen=True)
class Picture:
    """A camera image: compressed bytes, or pixels in one of ``pixels.ENCODINGS``."""

    time_ns: int | None
    data: bytes
    encoding: str | None = None
    """None if ``data`` is a JPEG or PNG file."""
    height: int = 0
    width: int = 0
    step: int = 0
    """Bytes from one row of pixels to the next."""


@dataclass(frozen=True)
class Event:
    """Something that happened: one of ``messages.EVENT_KINDS``, with details."""

    time_ns: int | None
    kind: str
    details: dict[str, str]


Decoded = Joints | Poses | Vector | Picture | Event


class Decoder:
    """Decodes the messages of one file."""

    def __init__(self) -> None:
        self._parsers: dict[int, tuple[Callable[[bytes], Any], Callable[[Any], Decoded]]] = {}

    def decode(self, channel: Channel, schema: Schema | None, data: bytes) -> Decoded:
        """Decode one message; raises DataError if its type is unknown or its bytes are bad."""
        if channel.id not in self._parsers:
            self._parsers[channel.id] = _parsers(channel, schema)
        parse, convert = self._parsers[channel.id]
        try:
            return convert(parse(data))
        except Exception as error:
            name = schema.name if schema else "no schema"
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DataError(f"{channel.topic}: not a valid {name} message ({text})") from None


def can_decode(schema: Schema | None) -> bool:
    """Return whether messages of this type can be decoded."""
    return schema is not None and schema.name in {**_PROTOBUF, **_ROS}


def _parsers(
    channel: Channel, schema: Schema | None
) -> tuple[Callable[[bytes], Any], Callable[[Any], Decoded]]:
    if schema is None:
        raise DataError(f"{channel.topic}: its schema is missing; nothing can be decoded")
    if channel.message_encoding == "protobuf" and schema.name in _PROTOBUF:
        # By the class that is installed, not by the description in the file: the field numbers
        # are stable, and a damaged description cannot reach the parser.
        if schema.name == "eisp.Vector":
            kind = messages.vector_class()
        else:
            kind = messages.foxglove_class(schema.name.removeprefix("foxglove."))
        return kind.FromString, _PROTOBUF[schema.name]
    if channel.message_encoding == "cdr" and schema.name in _ROS:
        return _ros_parser(channel, schema), _ROS[schema.name]
    known = ", ".join(sorted([*_PROTOBUF, *_ROS]))
    raise DataError(
        f"{channel.topic}: cannot decode {schema.name} in {channel.message_encoding!r}; "
        f"known types: {known}"
    )


def _ros_parser(channel: Channel, schema: Schema) -> Callable[[bytes], Any]:
    from mcap_ros2.decoder import DecoderFactory

    try:
        # Besides raising, the library prints several lines of its own.
        with contextlib.redirect_stderr(io.StringIO()):
            parse = DecoderFactory().decoder_for("cdr", schema)
    except Exception as error:  # A foreign text, parsed by a library that raises anything.
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{channel.topic}: bad definition of {schema.name} ({text})") from None
    if parse is None:
        raise DataError(
            f"{channel.topic}: {schema.name} is defined as {schema.encoding!r}; known: 'ros2msg'"
        )
    return parse


# Protobuf


def _proto_time(stamp: Any) -> int | None:
    return stamp.seconds * 1_000_000_000 + stamp.nanos or None


def _proto_xyz(point: Any) -> np.ndarray:
    return np.array([point.x, point.y, point.z])


def _wxyz(q: Any) -> np.ndarray:
    """Return a unit quaternion, wxyz; one that nobody set (all zero) means no rotation."""
    quaternion = np.array([q.w, q.x, q.y, q.z], np.float64)
    length = np.linalg.norm(quaternion)
    return quaternion / length if length > 0 else np.array([1.0, 0.0, 0.0, 0.0])


def _proto_joints(m: Any) -> Joints:
    def column(field: str) -> np.ndarray | None:
        if not all(joint.HasField(field) for joint in m.joints):
            return None
        return np.array([getattr(joint, field) for joint in m.joints], np.float64)

    names = tuple(joint.name for joint in m.joints)
    return Joints(
        _proto_time(m.timestamp), names, column("position"), column("velocity"), column("effort")
    )


def _proto_pose(m: Any) -> Poses:
    at = _proto_time(m.timestamp)
    place, turn = _proto_xyz(m.pose.position), _wxyz(m.pose.orientation)
    return Poses((Pose(at, m.frame_id, "", place, turn),))


def _proto_poses(m: Any) -> Poses:
    at = _proto_time(m.timestamp)
    return Poses(
        tuple(
            Pose(at, m.frame_id, str(i), _proto_xyz(p.position), _wxyz(p.orientation))
            for i, p in enumerate(m.poses)
        )
    )


def _proto_transform(m: Any) -> Pose:
    return Pose(
        _proto_time(m.timestamp),
        m.parent_frame_id,
        m.child_frame_id,
        _proto_xyz(m.translation),
        _wxyz(m.rotation),
    )


def _proto_event(m: Any) -> Event:
    details = {pair.key: pair.value for pair in m.metadata}
    return Event(_proto_time(m.start_time), details.pop("kind", ""), details)


_PROTOBUF: dict[str, Callable[[Any], Decoded]] = {
    "eisp.Vector": lambda m: Vector(
        _proto_time(m.timestamp), tuple(m.names), np.array(m.values, np.float64)
    ),
    "foxglove.CompressedImage": lambda m: Picture(_proto_time(m.timestamp), m.data),
    "foxglove.Event": _proto_event,
    "foxglove.FrameTransform": lambda m: Poses((_proto_transform(m),)),
    "foxglove.FrameTransforms": lambda m: Poses(tuple(_proto_transform(t) for t in m.transforms)),
    "foxglove.JointStates": _proto_joints,
    "foxglove.PoseInFrame": _proto_pose,
    "foxglove.PosesInFrame": _proto_poses,
    "foxglove.RawImage": lambda m: Picture(
        _proto_time(m.timestamp), m.data, m.encoding, m.height, m.width, m.step
    ),
}

# ROS 2


def _ros_time(header: Any) -> int | None:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec or None


def _ros_joints(m: Any) -> Joints:
    def column(values: Any) -> np.ndarray | None:
        if len(values) == 0:
            return None
        if len(values) != len(m.name):
            raise ValueError(f"{len(m.name)} names but {len(values)} values")
        return np.asarray(values, np.float64)

    return Joints(
        _ros_time(m.header),
        tuple(m.name),
        column(m.position),
        column(m.velocity),
        column(m.effort),
    )


def _ros_pose(m: Any) -> Poses:
    place, turn = _proto_xyz(m.pose.position), _wxyz(m.pose.orientation)
    return Poses((Pose(_ros_time(m.header), m.header.frame_id, "", place, turn),))


def _ros_transforms(m: Any) -> Poses:
    return Poses(
        tuple(
            Pose(
                _ros_time(t.header),
                t.header.frame_id,
                t.child_frame_id,
                _proto_xyz(t.transform.translation),
                _wxyz(t.transform.rotation),
            )
            for t in m.transforms
        )
    )


def _ros_twist(m: Any) -> Vector:
    values = np.concatenate([_proto_xyz(m.twist.linear), _proto_xyz(m.twist.angular)])
    return Vector(_ros_time(m.header), ("vx", "vy", "vz", "wx", "wy", "wz"), values)


def _ros_array(m: Any) -> Vector:
    return Vector(None, (), np.asarray(m.data, np.float64))


def _ros_text(m: Any) -> Event:
    """Read ``kind key=value …`` from a string message."""
    kind, *pairs = m.data.split() or [""]
    return Event(None, kind, dict(pair.split("=", 1) for pair in pairs if "=" in pair))


_ROS: dict[str, Callable[[Any], Decoded]] = {
    "geometry_msgs/msg/PoseStamped": _ros_pose,
    "geometry_msgs/msg/TwistStamped": _ros_twist,
    "sensor_msgs/msg/CompressedImage": lambda m: Picture(_ros_time(m.header), bytes(m.data)),
    "sensor_msgs/msg/Image": lambda m: Picture(
        _ros_time(m.header), bytes(m.data), m.encoding, m.height, m.width, m.step
    ),
    "sensor_msgs/msg/JointState": _ros_joints,
    "std_msgs/msg/Float32MultiArray": _ros_array,
    "std_msgs/msg/Float64MultiArray": _ros_array,
    "std_msgs/msg/String": _ros_text,
    "tf2_msgs/msg/TFMessage": _ros_transforms,
}
