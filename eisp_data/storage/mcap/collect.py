"""Gathering the samples of one stream of a mapping, message after message."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.mcap import decode, pixels
from eisp_data.storage.mcap.mapping import FIELDS, StreamMap
from eisp_data.storage.mcap.reader import Entry
from eisp_data.storage.mcap.resample import Series, make_series

Clock = Literal["hardware", "log"]
LAST_TIME_NS = 2**62
"""Times beyond it (in the year 2116) are damage."""


def time_of(entry: Entry, time_ns: int | None, clock: Clock) -> int:
    """Return when a sample was taken: by the sensor's clock, or when it was recorded.

    ``time_ns`` is what the message itself says; without it the publish time counts.
    """
    if clock == "log":
        return entry.message.log_time_ns
    return entry.message.publish_time_ns if time_ns is None else time_ns


@dataclass
class Source:
    """One stream of a mapping with its samples."""

    stream: StreamMap
    series: Series
    rule: str
    names: tuple[str, ...]
    """Name of each column, e.g. ``elbow_joint.position``."""
    log_times_ns: np.ndarray
    """(N,) int64: when each sample was recorded, to find images again."""
    lost_before: np.ndarray
    """(N,) int64: messages that are missing just before each sample, by their sequence numbers."""
    image_size: tuple[int, int] | None = None
    """(height, width) of the images that go into the dataset."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Reason to samples that were not used."""


def lost_before(sequences: np.ndarray) -> np.ndarray:
    """Return (N,) int64: how many messages are missing before each, by (N,) sequence numbers.

    Zeros where the numbers do not count the messages of the channel: many recorders leave them at
    0, and some count all channels together.
    """
    steps = np.diff(sequences, prepend=sequences[:1])
    counts = len(steps) > 1 and np.median(steps[1:]) == 1
    return np.maximum(steps - 1, 0) if counts else np.zeros_like(sequences)


class Collector:
    """Gathers the samples of one stream, one message after another."""

    def __init__(self, stream: StreamMap) -> None:
        self.stream = stream
        self.times, self.logged, self.sequences = array("q"), array("q"), array("q")
        self.values = array("d")
        self.names: tuple[str, ...] = ()
        self.quaternions: tuple[int, ...] = ()
        self.size: tuple[int, int] | None = None
        self.kind: type | None = None
        self.joints = stream.joints
        self.fields: tuple[str, ...] = ()
        self.left_out: dict[str, int] = {}

    def add(self, entry: Entry, decoded: decode.Decoded, clock: Clock) -> None:
        """Take in what one message holds for this stream."""
        if self.stream.camera is not None:
            self._add_image(entry, decoded, clock)
            return
        if isinstance(decoded, decode.Picture | decode.Event):
            raise ConfigError(
                f"{entry.topic}: {type(decoded).__name__.lower()}s cannot go to {self.stream.to}"
            )
        self.kind = type(decoded)
        for time_ns, values in self._parts(decoded):
            if len(values) != len(self.names):
                raise DataError(
                    f"{entry.topic}: {len(values)} values after {len(self.names)} before"
                )
            if not np.isfinite(values).all():
                self._leave_out("not finite")
            elif self._append(entry, time_ns, clock):
                self.values.extend(values)

    def source(self) -> Source:
        """Return what was gathered."""
        stream = self.stream
        if not self.times:
            what = f"{stream.topic} ({stream.frame})" if stream.frame else stream.topic
            why = ", ".join(f"{n} {reason}" for reason, n in self.left_out.items())
            raise DataError(f"{what}: no sample for {stream.to}" + (f"; {why}" if why else ""))
        times = np.frombuffer(self.times, np.int64)
        logged = np.frombuffer(self.logged, np.int64)
        values = np.frombuffer(self.values, np.float64).reshape(len(times), len(self.names))
        series = make_series(times, values, self.quaternions)
        usual = "interpolate" if self.kind is decode.Joints else "hold"
        rule = usual if stream.resampling == "default" else stream.resampling
        lost = lost_before(np.frombuffer(self.sequences, np.int64))
        at, lost = make_series(times, np.stack([logged, lost], axis=1)).values.T
        size = stream.size or self.size
        if size is not None and (size[0] % 2 or size[1] % 2):
            raise ConfigError(
                f"{stream.topic}: video needs an even height and width, got {size[0]}x{size[1]}; "
                "give a size in the mapping"
            )
        return Source(stream, series, rule, self.names, at, lost, size, self.left_out)

    def _append(self, entry: Entry, time_ns: int | None, clock: Clock) -> bool:
        at = time_of(entry, time_ns, clock)
        if not 0 <= at < LAST_TIME_NS or entry.message.log_time_ns >= LAST_TIME_NS:
            self._leave_out("with an impossible time")
            return False
        self.times.append(at)
        self.logged.append(entry.message.log_time_ns)
        self.sequences.append(entry.message.sequence)
        return True

    def _leave_out(self, reason: str) -> None:
        self.left_out[reason] = self.left_out.get(reason, 0) + 1

    def _add_image(self, entry: Entry, decoded: decode.Decoded, clock: Clock) -> None:
        if not isinstance(decoded, decode.Picture):
            raise ConfigError(f"{entry.topic}: not a channel of images, as {self.stream.to} needs")
        if self.size is None:
            self.size = pixels.size_of(decoded)
        self._append(entry, decoded.time_ns, clock)

    def _parts(
        self, decoded: decode.Joints | decode.Poses | decode.Vector
    ) -> Iterator[tuple[int | None, np.ndarray]]:
        if isinstance(decoded, decode.Joints):
            part = self._joints(decoded)
            if part is not None:
                yield decoded.time_ns, part
        elif isinstance(decoded, decode.Vector):
            self._fields("vector", ("values",))
            if not self.names:
                self.names = decoded.names or tuple(str(i) for i in range(len(decoded.values)))
            yield decoded.time_ns, decoded.values
        else:
            for pose in decoded.poses:
                if self.stream.frame in ("", pose.child) and (
                    self.stream.parent in ("", pose.parent)
                ):
                    yield pose.time_ns, self._pose(pose)

    def _fields(self, kind: str, default: tuple[str, ...]) -> tuple[str, ...]:
        chosen = self.stream.fields or default
        for name in chosen:
            if name not in FIELDS[kind]:
                raise ConfigError(
                    f"{self.stream.topic}: fields: {name!r} is not in its messages; "
                    f"choose from {', '.join(FIELDS[kind])}"
                )
        return chosen

    def _joints(self, decoded: decode.Joints) -> np.ndarray | None:
        if not self.fields:
            moving = ("position",) if decoded.velocity is None else ("position", "velocity")
            self.fields = self._fields("joints", moving)
        chosen = self.fields
        self.joints = wanted = self.joints or decoded.names
        places = {name: i for i, name in enumerate(decoded.names)}
        here = [name for name in wanted if name in places]
        if not here:
            return None  # Another part of the robot publishes its joints on the same topic.
        if len(here) < len(wanted):
            self._leave_out("without all joints")
            return None
        columns = []
        for name in chosen:
            column = getattr(decoded, name)
            if column is None:
                raise DataError(f"{self.stream.topic}: its messages carry no {name}")
            columns.append(column[[places[joint] for joint in wanted]])
        self.names = tuple(f"{joint}.{name}" for name in chosen for joint in wanted)
        return np.concatenate(columns)

    def _pose(self, pose: decode.Pose) -> np.ndarray:
        chosen = self._fields("poses", ("position", "orientation"))
        if not self.names:
            what = self.stream.frame or pose.child or self.stream.topic.strip("/")
            parts = {"position": ("x", "y", "z"), "orientation": ("qw", "qx", "qy", "qz")}
            self.names = tuple(f"{what}.{part}" for name in chosen for part in parts[name])
            starts = np.cumsum([0, *(len(parts[name]) for name in chosen)])
            self.quaternions = tuple(
                int(start)
                for name, start in zip(chosen, starts, strict=False)
                if name == "orientation"
            )
        return np.concatenate([getattr(pose, name) for name in chosen])
