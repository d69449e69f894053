"""The messages of a recording: Foxglove's schemas where there is one, and ``eisp.Vector``.

========================  ==============================  ==========================================
what                      schema                          builder
========================  ==============================  ==========================================
camera image (JPEG)       ``foxglove.CompressedImage``    :func:`image`
joint readings            ``foxglove.JointStates``        :func:`joints`
pose of one thing         ``foxglove.PoseInFrame``        :func:`pose`
poses of named things     ``foxglove.FrameTransforms``    :func:`transforms`
event                     ``foxglove.Event``              :func:`event`
any vector of numbers     ``eisp.Vector``                 :func:`vector`
========================  ==============================  ==========================================

Times are nanoseconds since the Unix epoch, positions metres, angles radians, quaternions wxyz.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message as ProtobufMessage

from eisp_data.errors import DataError

Numbers = Sequence[float] | np.ndarray

EVENT_KINDS = (
    "episode_start",
    "episode_end",
    "success",
    "subgoal",
    "intervention_start",
    "intervention_end",
    "dropped",
)
"""``episode_end`` may carry ``outcome`` (one of OUTCOMES); ``dropped`` is written by the recorder
itself, with the topic and how many messages were lost."""
OUTCOMES = ("success", "failure", "timeout", "discard")

_VECTOR_COMMENTS = {
    (4, 0): "Named numbers at one time: an action, an observation, a goal or a subgoal.",
    (4, 0, 2, 0): "Hardware time of the sample",
    (4, 0, 2, 1): "Name of each value with its unit, e.g. x_m; may be empty",
    (4, 0, 2, 2): "The values",
}


@cache
def vector_schema() -> descriptor_pb2.FileDescriptorSet:
    """Return the description of ``eisp.Vector``, comments included, as it goes into each file."""
    from google.protobuf import timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(
        name="eisp/Vector.proto",
        package="eisp",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    field = descriptor_pb2.FieldDescriptorProto
    message = file.message_type.add(name="Vector")
    message.field.add(
        name="timestamp",
        number=1,
        label=field.LABEL_OPTIONAL,
        type=field.TYPE_MESSAGE,
        type_name=".google.protobuf.Timestamp",
    )
    for number, name, kind in ((2, "names", field.TYPE_STRING), (3, "values", field.TYPE_DOUBLE)):
        message.field.add(name=name, number=number, label=field.LABEL_REPEATED, type=kind)
    for path, comment in _VECTOR_COMMENTS.items():
        file.source_code_info.location.add(path=path, leading_comments=comment, span=[0, 0, 0])
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    return descriptor_pb2.FileDescriptorSet(file=[stamp, file])


@cache
def vector_class() -> Any:
    """Return the message class of ``eisp.Vector``."""
    pool = descriptor_pool.DescriptorPool()
    for file in vector_schema().file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("eisp.Vector"))


@cache
def foxglove_class(name: str) -> Any:
    """Return the message class of ``foxglove.<name>``; raises DataError if there is none."""
    import importlib

    try:
        module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
        return getattr(module, name)
    except (ImportError, AttributeError):
        raise DataError(f"no Foxglove schema is called {name!r}") from None


def schema_of(kind: type[ProtobufMessage]) -> bytes:
    """Return the serialised description of a message class, as MCAP wants it."""
    from mcap_protobuf.schema import build_file_descriptor_set

    if kind is vector_class():
        return vector_schema().SerializeToString()
    return build_file_descriptor_set(kind).SerializeToString()


def set_time(timestamp: Any, time_ns: int) -> None:
    """Write ``time_ns`` into a protobuf ``Timestamp``."""
    timestamp.seconds, timestamp.nanos = divmod(int(time_ns), 1_000_000_000)


def image(
    jpeg: bytes, time_ns: int, frame_id: str = "camera", image_format: str = "jpeg"
) -> ProtobufMessage:
    """Build a camera image from bytes that are compressed already."""
    message = foxglove_class("CompressedImage")(frame_id=frame_id, data=jpeg, format=image_format)
    set_time(message.timestamp, time_ns)
    return message


def check_image(rgb: np.ndarray) -> None:
    """Raise DataError unless ``rgb`` is (H, W, 3) uint8."""
    if rgb.ndim != 3 or rgb.shape[-1] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
        raise DataError(f"image: expected (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}")


def encode_jpeg(rgb: np.ndarray, quality: int = 90) -> bytes:
    """Compress an image, (H, W, 3) uint8 RGB."""
    import cv2

    check_image(rgb)
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not done:
        raise DataError(f"image of shape {rgb.shape} could not be compressed")
    return data.tobytes()


def joints(
    names: Sequence[str],
    position: Numbers,
    time_ns: int,
    velocity: Numbers | None = None,
    effort: Numbers | None = None,
) -> ProtobufMessage:
    """Build the readings of all joints at one time."""
    message = foxglove_class("JointStates")()
    set_time(message.timestamp, time_ns)
    for given in (position, velocity, effort):
        if given is not None and len(given) != len(names):
            raise DataError(f"joints: {len(names)} names but {len(given)} values")
    for i, name in enumerate(names):
        joint = message.joints.add(name=name, position=float(position[i]))
        if velocity is not None:
            joint.velocity = float(velocity[i])
        if effort is not None:
            joint.effort = float(effort[i])
    return message


def _set_pose(position: Any, orientation: Any, xyz: Numbers, wxyz: Numbers) -> None:
    position.x, position.y, position.z = (float(v) for v in xyz)
    orientation.w, orientation.x, orientation.y, orientation.z = (float(v) for v in wxyz)


def pose(
    position_m: Numbers,
    quaternion_wxyz: Numbers,
    time_ns: int,
    frame_id: str = "base",
) -> ProtobufMessage:
    """Build the pose of one thing in ``frame_id``."""
    message = foxglove_class("PoseInFrame")(frame_id=frame_id)
    set_time(message.timestamp, time_ns)
    _set_pose(message.pose.position, message.pose.orientation, position_m, quaternion_wxyz)
    return message


def transforms(
    poses: Mapping[str, tuple[Numbers, Numbers]],
    time_ns: int | Mapping[str, int],
    frame_id: str = "base",
) -> ProtobufMessage:
    """Build the poses of named things in ``frame_id``: name to (position, quaternion wxyz).

    ``time_ns`` may differ from thing to thing: what is occluded keeps the time of its last sight.
    """
    message = foxglove_class("FrameTransforms")()
    for name, (position_m, quaternion_wxyz) in poses.items():
        transform = message.transforms.add(parent_frame_id=frame_id, child_frame_id=name)
        at = time_ns if isinstance(time_ns, int) else time_ns[name]
        set_time(transform.timestamp, at)
        _set_pose(transform.translation, transform.rotation, position_m, quaternion_wxyz)
    return message


def vector(values: Numbers, time_ns: int, names: Sequence[str] = ()) -> ProtobufMessage:
    """Build named numbers at one time."""
    if names and len(names) != len(values):
        raise DataError(f"vector: {len(names)} names but {len(values)} values")
    message = vector_class()(names=list(names), values=np.asarray(values, np.float64).tolist())
    set_time(message.timestamp, time_ns)
    return message


def event(kind: str, time_ns: int, details: Mapping[str, object] | None = None) -> ProtobufMessage:
    """Build an event of one of EVENT_KINDS with details as text."""
    if kind not in EVENT_KINDS:
        raise DataError(f"event {kind!r}: choose one of {', '.join(EVENT_KINDS)}")
    outcome = (details or {}).get("outcome")
    if kind == "episode_end" and outcome is not None and outcome not in OUTCOMES:
        raise DataError(f"outcome {outcome!r}: choose one of {', '.join(OUTCOMES)}")
    message = foxglove_class("Event")()
    set_time(message.start_time, time_ns)
    set_time(message.end_time, time_ns)
    for key, value in {"kind": kind, **(details or {})}.items():
        message.metadata.add(key=key, value=str(value))
    return message
