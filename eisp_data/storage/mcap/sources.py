"""Loading what a mapping names from a recording: numbers whole, images by their times only."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.mcap import decode, pixels
from eisp_data.storage.mcap.chain import chain, edges
from eisp_data.storage.mcap.collect import LAST_TIME_NS, Clock, Collector, Source, time_of
from eisp_data.storage.mcap.mapping import Mapping, StreamMap
from eisp_data.storage.mcap.reader import Entry, McapLog
from eisp_data.storage.mcap.resample import Series

STATIC = "_static"
"""What ROS appends to the topic of transforms for those that never change."""


@dataclass
class Recording:
    """What one file holds of a mapping."""

    path: Path
    """The file."""
    sources: list[Source]
    events: list[decode.Event]
    """In the order of their times, which are set."""
    problems: list[str]
    """What could not be read, one line each."""

    @property
    def first_ns(self) -> int:
        """Time of the first sample of any source."""
        return min(int(source.series.times_ns[0]) for source in self.sources)

    @property
    def commands(self) -> Series:
        """The samples of the action; its components have the same times."""
        return next(s.series for s in self.sources if s.stream.to == "action")


def load(log: McapLog, mapping: Mapping, clock: Clock) -> Recording:
    """Read all that ``mapping`` names from ``log`` in one pass, but no image.

    Raises DataError if a topic is missing, empty, or cannot be decoded.
    """
    for topic in sorted({stream.topic for stream in mapping.streams}):
        if topic not in log.topics and _needed(mapping, topic):
            known = ", ".join(sorted(log.topics)) or "none"
            raise DataError(f"{log.path}: no channel {topic}; it has {known}")
    streams = [stream for stream in mapping.streams if stream.to != "events"]
    collectors = [[Collector(edge) for edge in edges(stream)] for stream in streams]
    by_topic: dict[str, list[Collector]] = {}
    for parts in collectors:
        for collector in parts:
            by_topic.setdefault(collector.stream.topic, []).append(collector)
            if len(parts) > 1:  # Fixed transforms are on a topic of their own.
                static = collector.stream.topic + STATIC
                by_topic.setdefault(static, []).append(collector)
    event_topics = {s.topic for s in mapping.streams if s.to == "events"}
    decoder, events = decode.Decoder(), []
    for entry in log.messages({*by_topic, *event_topics}, in_order=False):
        decoded = decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
        if entry.topic in event_topics and isinstance(decoded, decode.Event):
            events.append(_timed(decoded, entry, clock))
        for collector in by_topic.get(entry.topic, ()):
            collector.add(entry, decoded, clock)
    events.sort(key=lambda event: event.time_ns or 0)
    try:
        sources = [_source(s, parts) for s, parts in zip(streams, collectors, strict=True)]
    except DataError as error:
        raise DataError(f"{log.path}: {error}") from None
    return Recording(log.path, sources, events, log.problems)


def _source(stream: StreamMap, parts: list[Collector]) -> Source:
    found = [collector.source() for collector in parts]
    return chain(stream, found) if stream.via else found[0]


def _needed(mapping: Mapping, topic: str) -> bool:
    """Return whether the conversion cannot do without ``topic``: without events it can."""
    return any(s.topic == topic and s.to != "events" for s in mapping.streams)


def _timed(event: decode.Event, entry: Entry, clock: Clock) -> decode.Event:
    at = min(time_of(entry, event.time_ns, clock), LAST_TIME_NS)
    return decode.Event(at, event.kind, event.details)


def fetch_images(log: McapLog, source: Source, chosen: np.ndarray, clock: Clock) -> np.ndarray:
    """Return the images (K, H, W, 3) uint8 RGB of the samples ``chosen`` (K,) of ``source``."""
    if source.image_size is None:
        raise DataError(f"{source.stream.topic}: not a channel of images")
    frames = np.empty((len(chosen), *source.image_size, 3), np.uint8)
    found = np.zeros(len(chosen), bool)
    rows: dict[int, list[int]] = {}
    for row, sample in enumerate(chosen):
        rows.setdefault(int(source.series.times_ns[sample]), []).append(row)
    logged = source.log_times_ns[chosen]
    decoder = decode.Decoder()
    start, end = int(logged.min()), int(logged.max()) + 1
    for entry in log.messages({source.stream.topic}, start, end, in_order=False):
        picture = decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
        if not isinstance(picture, decode.Picture):
            continue
        at = rows.get(time_of(entry, picture.time_ns, clock))
        if at is not None:
            frames[at] = pixels.rgb(picture, source.image_size)
            found[at] = True
    if not found.all():
        raise DataError(f"{log.path}: {source.stream.topic} changed while it was read")
    return frames
