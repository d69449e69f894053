"""The mapping that a recording suggests by itself: from its channels' metadata, types and names."""

from __future__ import annotations

from eisp_data.errors import DataError
from eisp_data.storage.mcap import decode
from eisp_data.storage.mcap.mapping import Mapping, StreamMap
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.sources import STATIC
from eisp_data.storage.mcap.writer import ROLE_KEY, camera_name

_LOOKED_AT = 200
"""How many messages of a channel of transforms are read for the names of their frames."""
_STATE, _WORLD = "observation.state", "observation.environment_state"
_REACHED, _WANTED = "observation.achieved_goal", "observation.desired_goal"
_WORDS = {
    "action": ("command", "commands", "cmd", "action", "cmd_vel"),
    _WANTED: ("goal", "desired_goal"),
}


def guess_mapping(log: McapLog) -> Mapping:
    """Return a mapping for ``log``.

    A channel's role in its metadata (``eisp.role``) counts first. Where no channel claims a
    column, joints become the state, poses the environment and their positions the achieved goal,
    channels of numbers called ``command`` or ``goal`` action and desired goal; images are images.
    Raises DataError, naming what is missing, if that is not enough to make a dataset of.
    """
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
    roles = {stream.to for stream in streams}
    missing = [role for role in (_STATE, _REACHED, "action") if role not in roles]
    if missing:
        raise DataError(
            f"{log.path}: nothing in it tells what {' and '.join(missing)} should be; give a "
            f"mapping file. It has the channels {', '.join(sorted(log.topics)) or 'none'}"
        )
    session = log.metadata().get("session", {})
    return Mapping(
        streams=tuple(streams),
        task=session.get("task", ""),
        instruction=session.get("instruction", ""),
    )


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
