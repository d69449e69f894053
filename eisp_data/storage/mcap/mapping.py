"""Which channel becomes which column: the mapping of a recording onto a LeRobot dataset.

A mapping is a small YAML file, for instance for a ROS 2 bag::

    instruction: Stack the three blocks.
    streams:
      - {topic: /joint_states, to: observation.state, fields: [position, velocity],
         joints: [shoulder_pan_joint, elbow_joint], rule: interpolate}
      - {topic: /tf, frame: block_0, to: observation.environment_state}
      - {topic: /tf, frame: block_0, to: observation.achieved_goal, fields: [position]}
      - {topic: /camera/image_raw/compressed, to: observation.images.top, size: [48, 48]}
      - {topic: /velocity_controller/commands, to: action, low: [-1, -1], high: [1, 1]}
      - {topic: /episode, to: events}

Recordings of this toolkit say it themselves, in the metadata of their channels.
"""

from __future__ import annotations

from collections.abc import Mapping as Dict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from eisp_data.errors import ConfigError
from eisp_data.storage.schema import AGE, IMAGE, INTERVENTION, REPEATED, is_standard

ROLES = (
    "observation.state",
    "observation.environment_state",
    "observation.achieved_goal",
    "observation.desired_goal",
    "action",
    "events",
)
"""Beside these, ``observation.images.<camera>`` and ``extra.<column>``."""
RULES = ("hold", "nearest", "interpolate")
"""hold: the newest sample at or before the row's time, what a policy could have known;
nearest: the sample closest in time, before or after; interpolate: between its neighbours,
linear, orientations along the shortest arc."""
FIELDS = {
    "joints": ("position", "velocity", "effort"),
    "poses": ("position", "orientation"),
    "vector": ("values",),
}
EXTRA = "extra."
NEEDED = ("observation.state", "observation.achieved_goal", "action")
"""Roles without which a recording makes no dataset."""


def check_role(topic: str, role: str) -> None:
    """Raise ConfigError unless ``role`` is one that a channel can have."""
    named = any(role.startswith(front) and role != front for front in (IMAGE, EXTRA))
    if role not in ROLES and not named:
        raise ConfigError(
            f"{topic}: to: {role!r}; choose one of {', '.join(ROLES)}, "
            f"{IMAGE}<camera>, {EXTRA}<column>"
        )
    column = role.removeprefix(EXTRA)
    made = column == INTERVENTION or column.startswith((AGE, REPEATED))
    if role.startswith(EXTRA) and (made or is_standard(column)):
        raise ConfigError(
            f"{topic}: to: {role!r}: {column!r} is a column that datasets have of their own; "
            "choose another name"
        )


@dataclass(frozen=True, kw_only=True)
class StreamMap:
    """One channel, or a part of it, and the column that it becomes."""

    topic: str
    """Topic of the channel."""
    to: str
    """One of ROLES, ``observation.images.<camera>`` or ``extra.<column>``; streams with the same
    one are put side by side, in the order of the mapping."""
    rule: str = ""
    """One of RULES; empty for the default: interpolate for joints, nearest for actions, else
    hold."""
    fields: tuple[str, ...] = ()
    """Parts of the message: of joints position, velocity, effort (by default the first two where
    the first message carries them); of poses position, orientation (default both, wxyz)."""
    joints: tuple[str, ...] = ()
    """Which joints, in which order; by default all those of the first message."""
    frame: str = ""
    """Of transforms: the child frame."""
    parent: str = ""
    """Of transforms: the parent frame, if a child appears under several."""
    via: tuple[str, ...] = ()
    """Of transforms: the frames between parent and frame, for instance the camera's; transforms
    on ``<topic>_static`` count too."""
    low: tuple[float, ...] = ()
    """Of actions: what becomes -1, one value for each component."""
    high: tuple[float, ...] = ()
    """Of actions: what becomes 1."""
    size: tuple[int, int] | None = None
    """Of images: (height, width) to resize to, both even; by default as recorded."""
    max_age_s: float = 0.0
    """Rows for which this source is older than that are left out, and the episode is cut there;
    0 keeps them, with the age in its column."""

    def __post_init__(self) -> None:
        check_role(self.topic, self.to)
        if self.via and not (self.parent and self.frame):
            raise ConfigError(f"{self.topic}: via needs both parent and frame")
        if self.rule not in ("", *RULES):
            raise ConfigError(
                f"{self.topic}: rule: {self.rule!r}; choose one of {', '.join(RULES)}"
            )
        if self.camera is not None and self.rule == "interpolate":
            raise ConfigError(f"{self.topic}: images cannot be interpolated; hold or nearest")
        known = sorted({name for names in FIELDS.values() for name in names})
        for name in self.fields:
            if name not in known:
                raise ConfigError(f"{self.topic}: fields: {name!r}; choose from {', '.join(known)}")
        if len(self.low) != len(self.high) or any(
            not low < high for low, high in zip(self.low, self.high, strict=True)
        ):
            raise ConfigError(f"{self.topic}: low and high must pair up, each low below its high")
        if self.size is not None and (min(self.size) < 2 or self.size[0] % 2 or self.size[1] % 2):
            raise ConfigError(f"{self.topic}: size must be even, got {list(self.size)}")
        if not 0 <= self.max_age_s < float("inf"):
            raise ConfigError(f"{self.topic}: max_age_s must be 0 or above, got {self.max_age_s}")

    @property
    def name(self) -> str:
        """A short name, unique among the sources of one column: topic and frame."""
        return ".".join(part for part in (*self.topic.split("/"), self.frame) if part)

    @property
    def camera(self) -> str | None:
        """The camera's name if this is an image."""
        return self.to.removeprefix(IMAGE) if self.to.startswith(IMAGE) else None

    @property
    def resampling(self) -> str:
        """The rule, with ``default`` standing for one that depends on the type of message."""
        return self.rule or ("nearest" if self.to == "action" else "default")


@dataclass(frozen=True, kw_only=True)
class Mapping:
    """What a recording becomes."""

    streams: tuple[StreamMap, ...]
    """The channels to use."""
    instruction: str = ""
    """The task as one English sentence; empty to take it from the recording or the command."""
    task: str = ""
    """Registry name of the task; the same."""

    def __post_init__(self) -> None:
        roles = [stream.to for stream in self.streams]
        for needed in NEEDED:
            if needed not in roles:
                raise ConfigError(
                    f"mapping: no stream has to: {needed}; it has {', '.join(sorted(set(roles)))}"
                )
        for role in {r for r in roles if r.startswith(IMAGE) or r == "events"}:
            if roles.count(role) > 1:
                raise ConfigError(f"mapping: {roles.count(role)} streams have to: {role}, not 1")

    def to_json(self) -> dict[str, Any]:
        """Return plain values that ``from_json`` takes back, defaults left out."""
        return _plain(self.streams, self.instruction, self.task)

    @classmethod
    def from_json(cls, values: Any) -> Mapping:
        """Build a mapping from plain values; raises ConfigError naming what is wrong."""
        values = _checked(values, cls, "mapping")
        streams = values.get("streams")
        if not isinstance(streams, list) or not streams:
            raise ConfigError("mapping: 'streams' must be a list of at least one stream")
        found = tuple(_stream(stream, i) for i, stream in enumerate(streams))
        return cls(**{**values, "streams": found})


def mapping_yaml(streams: Sequence[StreamMap], instruction: str, task: str) -> str:
    """Return the text of a mapping file, which need not be a whole mapping yet."""
    return yaml.safe_dump(_plain(streams, instruction, task), sort_keys=False, allow_unicode=True)


def _plain(streams: Sequence[StreamMap], instruction: str, task: str) -> dict[str, Any]:
    plain = []
    for stream in streams:
        default = StreamMap(topic=stream.topic, to=stream.to)
        changed = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(stream).items()
            if value != getattr(default, key)
        }
        plain.append({"topic": stream.topic, "to": stream.to, **changed})
    return {"instruction": instruction, "task": task, "streams": plain}


def load_mapping(path: str | Path) -> Mapping:
    """Read a mapping file; raises ConfigError naming file and fault."""
    try:
        return Mapping.from_json(yaml.safe_load(Path(path).read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not YAML ({str(error).splitlines()[0]})") from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _stream(values: Any, number: int) -> StreamMap:
    values = _checked(values, StreamMap, f"stream {number}")
    lists: dict[str, type] = {"fields": str, "joints": str, "via": str, "low": float, "high": float}
    lists["size"] = int
    for key in ("topic", "to"):
        if key not in values:
            raise ConfigError(f"stream {number}: {key!r} is missing")
    try:
        for key, value in values.items():
            if key in lists and value is not None:
                if isinstance(value, str):
                    raise ValueError
                values[key] = tuple(lists[key](v) for v in value)
            elif key == "max_age_s":
                values[key] = float(value)
            elif not isinstance(value, str) and value is not None:
                raise ValueError
        if len(values.get("size") or (0, 0)) != 2:
            raise ValueError
    except (TypeError, ValueError):
        raise ConfigError(f"stream {number}: {key}: {value!r} is not of the right kind") from None
    return StreamMap(**values)


def _checked(values: Any, kind: type, where: str) -> dict[str, Any]:
    known = [f.name for f in fields(kind)]
    if not isinstance(values, Dict):
        raise ConfigError(f"{where}: expected keys and values, got {values!r}")
    for key in values:
        if key not in known:
            raise ConfigError(f"{where}: unknown key {key!r}; known: {', '.join(known)}")
    return dict(values)
