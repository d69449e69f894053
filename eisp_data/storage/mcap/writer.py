"""Recording to MCAP from a control loop: calls never wait, memory is bounded, drops are flagged.

A background thread compresses images, writes, and every ``flush_s`` ends the chunk and pushes it
to the disk. So a process that is killed loses what it logged in its last second at most, and a
file without its footer is read as it stands by :class:`~eisp_data.storage.mcap.reader.McapLog`
or made whole by ``eisp-data repair``.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, Writer

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.backlog import Backlog, Item
from eisp_data.storage.mcap.mapping import check_role
from eisp_data.storage.mcap.tally import LIBRARY

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
EVENTS_TOPIC = "/events"
ROLE_KEY = "eisp.role"
"""Channel metadata: what ``eisp-data convert`` makes of the channel (see ``mapping.ROLES``)."""
_OVERHEAD_BYTES = 512
"""What a queued message costs in memory beside its payload, about."""


@dataclass(frozen=True)
class McapWriterConfig:
    """How a recording is written."""

    compression: Literal["zstd", "lz4", "none"] = "zstd"
    """Of each chunk; images are JPEG already and hardly shrink further."""
    chunk_bytes: int = 1024 * 1024
    """A chunk ends at this size, or earlier at the next flush."""
    flush_s: float = 0.4
    """The longest time that a message waits for its chunk to be written, in seconds."""
    queue_bytes: int = 64 * 2**20
    """The most that waits in memory; what comes beyond it is dropped and flagged."""
    jpeg_quality: int = 90
    """Quality of images that are given as arrays, 1 to 100."""
    fsync: bool = True
    """Ask the disk itself to store each flush, so that a pulled cable costs no more than a kill."""

    def __post_init__(self) -> None:
        if self.compression not in COMPRESSIONS:
            raise ConfigError(
                f"compression {self.compression!r}: choose one of {', '.join(COMPRESSIONS)}"
            )
        for name in ("chunk_bytes", "flush_s", "queue_bytes"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 1 <= self.jpeg_quality <= 100:
            raise ConfigError(f"jpeg_quality must be 1 to 100, got {self.jpeg_quality}")


@dataclass(frozen=True)
class WriterStats:
    """What became of the messages so far."""

    written: Mapping[str, int]
    """Topic to messages in the file."""
    dropped: Mapping[str, int]
    """Topic to messages for which the queue had no room."""
    waiting_bytes: int
    """What is in memory and not yet in the file."""


_NOT_A_NAME = ("", "camera", "color", "image", "image_raw", "image_rect", "compressed")


@dataclass(frozen=True, slots=True)
class Picture:
    """An image in the queue: JPEG bytes, or (H, W, 3) uint8 RGB still to be compressed."""

    image: np.ndarray | bytes


def camera_name(topic: str) -> str:
    """Return the camera's name: ``top`` for ``/camera/top/image`` as for ``/top``."""
    parts = [part for part in topic.split("/") if part not in _NOT_A_NAME]
    return "_".join(parts) or "camera"


class McapWriter:
    """Writes one recording; a context manager, safe to call from several threads.

    ``log`` returns whether the message was taken. Each channel's sequence number also counts the
    messages that were not, so a reader sees every drop, and an event of kind ``dropped`` says so
    in the file itself. A disk error (full, gone) is raised by the next ``log``, and by ``close``.
    """

    def __init__(
        self,
        path: str | Path,
        config: McapWriterConfig | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Create ``path``, which must not exist; ``metadata`` describes the session."""
        self.path, self.config = Path(path), config or McapWriterConfig()
        try:
            self._file = self.path.open("xb")
        except FileExistsError:
            raise DataError(f"{path} exists already; a recording is never overwritten") from None
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}") from None
        # Wall-clock time that cannot jump back when the system clock is set.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._backlog = Backlog(self.config.queue_bytes)
        self._written: Counter[str] = Counter()
        self._flagged: Counter[str] = Counter()
        self._sequences: Counter[str] = Counter()
        self._kinds: dict[str, tuple[type[ProtobufMessage], str | None]] = {}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._order = threading.Lock()
        self._error: Exception | None = None
        self._flushed_s = time.monotonic()
        self._writer = Writer(
            self._file,
            chunk_size=self.config.chunk_bytes,
            compression=COMPRESSIONS[self.config.compression],
        )
        self._session = dict(metadata or {})
        self._thread = threading.Thread(target=self._run, name=f"mcap {self.path.name}")
        self._thread.daemon = True
        self._thread.start()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now_ns(self) -> int:
        """Return the log clock: nanoseconds since the epoch, never going backwards."""
        return self._epoch_ns + time.monotonic_ns()

    def log(
        self,
        topic: str,
        message: ProtobufMessage,
        publish_time_ns: int | None = None,
        role: str | None = None,
    ) -> bool:
        """Queue a message with its hardware time (now, if None); return whether it was taken.

        ``role`` tells the conversion what the channel is; that of the first message counts.
        """
        # Serialised here, so that the caller may change the message afterwards.
        data = message.SerializeToString()
        return self._put(topic, data, len(data), type(message), publish_time_ns, role)

    def image(
        self, topic: str, image: np.ndarray | bytes, publish_time_ns: int | None = None
    ) -> bool:
        """Queue a camera image: JPEG bytes, or (H, W, 3) uint8 RGB, compressed in the background.

        The array must not be changed afterwards.
        """
        if isinstance(image, np.ndarray):
            messages.check_image(image)
        size = len(image) if isinstance(image, bytes) else image.nbytes
        kind = messages.foxglove_class("CompressedImage")
        return self._put(
            topic,
            Picture(image),
            size,
            kind,
            publish_time_ns,
            f"observation.images.{camera_name(topic)}",
        )

    def vector(
        self,
        topic: str,
        values: messages.Numbers,
        publish_time_ns: int | None = None,
        names: Sequence[str] = (),
        role: str | None = None,
    ) -> bool:
        """Queue named numbers: a command as it was really sent, an observation, a (sub)goal."""
        at = self.now_ns() if publish_time_ns is None else publish_time_ns
        return self.log(topic, messages.vector(values, at, names), at, role)

    def event(self, kind: str, publish_time_ns: int | None = None, **details: object) -> bool:
        """Queue an event; see ``messages.EVENT_KINDS``."""
        at = self.now_ns() if publish_time_ns is None else publish_time_ns
        return self.log(EVENTS_TOPIC, messages.event(kind, at, details), at, "events")

    def stats(self) -> WriterStats:
        """Return how many messages were written and dropped, by topic, and what is waiting."""
        backlog = self._backlog
        return WriterStats(dict(self._written), dict(backlog.dropped), backlog.waiting_bytes)

    def close(self) -> WriterStats:
        """Write what is waiting, the index and the footer; raises DataError if that failed."""
        self._backlog.close()
        self._thread.join()
        try:
            self._file.close()
        except OSError as error:  # What is still buffered finds no room either.
            self._error = self._error or error
        self._raise()
        return self.stats()

    def _put(
        self,
        topic: str,
        payload: object,
        size: int,
        kind: type[ProtobufMessage],
        publish_time_ns: int | None,
        role: str | None,
    ) -> bool:
        self._raise()
        if role is not None and topic not in self._kinds:
            check_role(topic, role)
        known = self._kinds.setdefault(topic, (kind, role))[0]
        if known is not kind:
            name, other = known.DESCRIPTOR.full_name, kind.DESCRIPTOR.full_name
            raise DataError(f"channel {topic} carries {name}, not {other}")
        # Under one lock, so that log times and sequence numbers rise in the order of the file.
        with self._order:
            now, sequence = self.now_ns(), self._sequences[topic]
            self._sequences[topic] += 1
            at = now if publish_time_ns is None else int(publish_time_ns)
            item = Item(topic, payload, now, at, sequence, size + _OVERHEAD_BYTES)
            return self._backlog.put(item, bulky=isinstance(payload, Picture))

    def _raise(self) -> None:
        if self._error is not None:
            raise DataError(f"{self.path}: recording stopped: {self._error}") from self._error

    # What follows runs in the background thread only.

    def _run(self) -> None:
        try:
            self._writer.start(profile="", library=LIBRARY)
            if self._session:
                self._writer.add_metadata("session", self._session)
            self._flush()
            while (items := self._backlog.take(self.config.flush_s / 4)) is not None:
                for item in items:
                    self._write(item)
                    self._backlog.done(item)
                    self._flush_if_due()
                self._flag_drops()
                self._flush_if_due()
            self._flag_drops()
            for item in self._backlog.take(0) or []:
                self._write(item)
            self._writer.finish()
            self._sync()
        except Exception as error:  # Whatever it is, the recording ends here and says so.
            self._error = error
            self._backlog.close()

    def _write(self, item: Item) -> None:
        data = item.payload
        if isinstance(data, Picture):
            jpeg = data.image
            if isinstance(jpeg, np.ndarray):
                jpeg = messages.encode_jpeg(jpeg, self.config.jpeg_quality)
            message = messages.image(jpeg, item.publish_time_ns, camera_name(item.topic))
            data = message.SerializeToString()
        if item.topic not in self._channels:
            self._channels[item.topic] = self._register(item.topic)
        self._writer.add_message(
            self._channels[item.topic],
            item.log_time_ns,
            data,
            item.publish_time_ns,
            item.sequence,
        )
        self._written[item.topic] += 1

    def _register(self, topic: str) -> int:
        kind, role = self._kinds[topic]
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            data = messages.schema_of(kind)
            self._schemas[name] = self._writer.register_schema(name, "protobuf", data)
        metadata = {ROLE_KEY: role} if role else {}
        return self._writer.register_channel(topic, "protobuf", self._schemas[name], metadata)

    def _flag_drops(self) -> None:
        for topic, count in list(self._backlog.dropped.items()):
            new = count - self._flagged[topic]
            if new:
                self._flagged[topic] = count
                # Queued like all others: events that wait already have earlier times and numbers.
                with self._order:
                    now, sequence = self.now_ns(), self._sequences[EVENTS_TOPIC]
                    self._sequences[EVENTS_TOPIC] += 1
                    message = messages.event("dropped", now, {"topic": topic, "count": new})
                    self._kinds.setdefault(EVENTS_TOPIC, (type(message), "events"))
                    data = message.SerializeToString()
                    self._backlog.add(Item(EVENTS_TOPIC, data, now, now, sequence, 0))

    def _flush_if_due(self) -> None:
        if time.monotonic() - self._flushed_s >= self.config.flush_s:
            self._flush()

    def _flush(self) -> None:
        self._writer.flush()
        self._sync()
        self._flushed_s = time.monotonic()

    def _sync(self) -> None:
        self._file.flush()
        if self.config.fsync:
            os.fsync(self._file.fileno())
