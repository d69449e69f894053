"""The mapping that a recording suggests by itself: from its channels' metadata, types and names."""

from __future__ import annotations

import re

from eisp_data.errors import DataError
from eisp_data.storage.mcap import decode
from eisp_data.storage.mcap.mapping import NEEDED, Mapping, StreamMap, mapping_yaml
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.sources import STATIC
from eisp_data.storage.mcap.writer import ROLE_KEY, camera_name

_LOOKED_AT = 200
"""How many messages of a channel of transforms are read for the names of their frames."""
_STATE, _WORLD = "observation.state", "observation.environment_state"
_REACHED, _WANTED = "observation.achieved_goal", "observation.desired_goal"
_ROBOT = {"gripper", "tool", "tool0", "tcp", "ee", "eef", "effector", "hand", "flange", "wrist"}
_WORDS = {
    "action": ("command", "commands", "cmd", "action", "cmd_vel", "delta_twist_cmds"),
    _WANTED: ("goal", "desired_goal"),
}


def guess_mapping(log: McapLog) -> Mapping:
    """Return a mapping for ``log``.

    A channel's role in its metadata (``eisp.role``) counts first. Where no channel claims a
    column, joints become the state, poses the environment and their positions the achieved goal,
    channels of numbers called ``command`` or ``goal`` action and desired goal; images are images.
    Raises DataError, naming what is missing, if that is not enough to make a dataset of.
    """
    streams, missing = _guess(log)
    if missing:
        raise DataError(
            f"{log.path}: nothing in it tells what {' and '.join(missing)} should be; give a "
            "mapping file (--show-mapping prints what to begin with). It has the channels "
            f"{', '.join(sorted(log.topics)) or 'none'}"
        )
    return Mapping(streams=streams, **_session(log))


def suggestion(log: McapLog) -> str:
    """Return the text of a mapping file to be edited: what is missing, and the channels that it
    does not use, are comments in it."""
    streams, missing = _guess(log)
    notes = [f"still needed: a stream with to: {role}" for role in missing]
    for topic in sorted(set(log.topics) - {stream.topic for stream in streams}):
        schema = log.schema_of(log.topics[topic])
        notes.append(f"not used: {topic} ({schema.name if schema else 'no schema'})")
    return mapping_yaml(streams, **_session(log)) + "".join(f"# {note}\n" for note in notes)


def _session(log: McapLog) -> dict[str, str]:
    said = log.metadata().get("session", {})
    return {"task": said.get("task", ""), "instruction": said.get("instruction", "")}


def _guess(log: McapLog) -> tuple[tuple[StreamMap, ...], list[str]]:
    """Return the streams that a recording suggests, and the roles that none of them has."""
    claimed = {
        topic: channel.metadata[ROLE_KEY]
        for topic, channel in log.topics.items()
        if channel.metadata.get(ROLE_KEY)
    }
    streams = [StreamMap(topic=topic, to=role) for topic, role in claimed.items()]
    taken = set(claimed.values())
    for topic in sorted(set(log.topics) - set(claimed)):
        found = [stream for stream in _by_type(log, topic) if stream.to not in taken]
        # One topic for each camera and for the events; raw and compressed are the same images.
        taken |= {s.to for s in found if s.camera or s.to == "events"}
        streams += found
    # Where the robot is itself is a goal only if it is all there is to reach.
    reached = [s for s in streams if s.to == _REACHED and s.topic not in claimed]
    of_robot = [stream for stream in reached if _is_of_robot(stream)]
    if len(of_robot) < len(reached):
        streams = [stream for stream in streams if stream not in of_robot]
    roles = {stream.to for stream in streams}
    return tuple(streams), [role for role in NEEDED if role not in roles]


def _is_of_robot(stream: StreamMap) -> bool:
    return not _ROBOT.isdisjoint(re.split(r"[/_]", f"{stream.topic}/{stream.frame}".lower()))


def _by_type(log: McapLog, topic: str) -> list[StreamMap]:
    schema = log.schema_of(log.topics[topic])
    name = schema.name.split("/")[-1].removeprefix("foxglove.") if schema else ""
    if not decode.can_decode(schema):
        return []
    if name in ("JointStates", "JointState"):
        return [StreamMap(topic=topic, to=_STATE)]
    if name in ("CompressedImage", "RawImage", "Image"):
        return [StreamMap(topic=topic, to=f"observation.images.{camera_name(topic)}")]
    if name in ("Event", "String"):
        events = name == "Event" or "event" in topic or "episode" in topic
        return [StreamMap(topic=topic, to="events")] if events else []
    if name in ("Vector", "Float64MultiArray", "Float32MultiArray", "TwistStamped"):
        last = topic.split("/")[-1]
        return [StreamMap(topic=topic, to=to) for to, words in _WORDS.items() if last in words]
    if topic.endswith(STATIC):
        return []  # How a camera is mounted is no object to be moved.
    streams = []
    for frame in _frames(log, topic):
        streams.append(StreamMap(topic=topic, frame=frame, to=_WORLD))
        streams.append(StreamMap(topic=topic, frame=frame, to=_REACHED, fields=("position",)))
    return streams


def _frames(log: McapLog, topic: str) -> list[str]:
    """Return the names of the things whose poses are on ``topic``, in alphabetical order."""
    decoder, found = decode.Decoder(), set()
    for number, entry in enumerate(log.messages({topic}, in_order=False)):
        decoded = decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
        if isinstance(decoded, decode.Poses):
            found |= {pose.child for pose in decoded.poses}
        if number >= _LOOKED_AT:
            break
    return sorted(found)
