"""Reading an MCAP file, whole or damaged: every complete chunk, and a list of what was lost."""

from __future__ import annotations

import contextlib
import heapq
import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema, Statistics

from eisp_data.errors import DataError
from eisp_data.storage.mcap import records, scan
from eisp_data.storage.mcap.records import BadRecord, Message
from eisp_data.storage.mcap.scan import Segment
from eisp_data.storage.mcap.tally import ChannelStats, Tally

_HEADER_BYTES = 2**16
MAX_BUFFER_BYTES = 512 * 2**20
"""How much of a file whose chunks overlap in time is held to put its messages in order."""


class Entry(NamedTuple):
    """A message with the channel it came on."""

    topic: str
    channel: Channel
    message: Message


class McapLog:
    """An MCAP file opened for reading; a context manager.

    Whatever is whole is read; ``problems`` says, one line each, what is not, and grows while
    messages are read, because a chunk's CRC is checked only then.

    Raises DataError if the file is missing, empty or not an MCAP file of version 0.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self._file = self.path.open("rb")
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}") from None
        try:
            records.check_magic(self._file.read(len(records.MAGIC)), path)
            self.layout = scan.walk(self._file)
        except BaseException:
            self._file.close()
            raise
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.statistics: Statistics | None = None
        """What the summary says the file holds."""
        self._bad_segments: dict[Segment, str] = {}
        self._unknown: dict[int, int] = {}
        self._open = True
        self.indexed = self._read_summary()
        """The file has a summary that passes its CRC, so that any reader opens it."""
        if not self.indexed:
            for segment in self.layout.segments:
                for _ in self._segment(segment):
                    pass
            for opcode, body in self._bodies(self.layout.definitions):
                with contextlib.suppress(BadRecord):
                    self._define(opcode, body)
        # From here on the channels are known, and a damaged definition changes nothing.
        self._open = False

    def __enter__(self) -> McapLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def problems(self) -> list[str]:
        """Everything found wrong so far, one line each."""
        bad = [f"byte {s.offset}: {why}" for s, why in self._bad_segments.items()]
        unknown = [f"{n} message(s) of undefined channel {i}" for i, n in self._unknown.items()]
        return [*self.layout.problems, *bad, *unknown]

    @property
    def topics(self) -> dict[str, Channel]:
        """Topic to channel; of channels that share a topic, the last one defined."""
        return {channel.topic: channel for channel in self.channels.values()}

    def schema_of(self, channel: Channel) -> Schema | None:
        """Return the schema of ``channel``; None if it has none or it was lost."""
        return self.schemas.get(channel.schema_id)

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        in_order: bool = True,
    ) -> Iterator[Entry]:
        """Yield messages of ``topics`` (all of them by default) with start <= log time < end.

        In order of log time, or (``in_order=False``) as they lie in the file, which holds one
        chunk in memory whatever the file looks like.
        """
        self._unknown.clear()
        segments = [
            s
            for s in self.layout.segments
            if (end_ns is None or s.start_ns < end_ns)
            and (start_ns is None or s.end_ns >= start_ns)
        ]
        if in_order:
            segments.sort(key=lambda s: (s.start_ns, s.offset))
        waiting: list[tuple[int, int, int, Message]] = []
        held = 0
        for number, segment in enumerate(segments):
            for place, message in enumerate(self._segment(segment)):
                if not self._wanted(message, topics, start_ns, end_ns):
                    continue
                if not in_order:
                    yield self._entry(message)
                    continue
                heapq.heappush(waiting, (message.log_time_ns, number, place, message))
                held += len(message.data)
            following = segments[number + 1].start_ns if number + 1 < len(segments) else None
            while waiting and (following is None or waiting[0][0] < following):
                message = heapq.heappop(waiting)[3]
                held -= len(message.data)
                yield self._entry(message)
            if held > MAX_BUFFER_BYTES:
                raise DataError(
                    f"{self.path}: chunks overlap in time by more than {MAX_BUFFER_BYTES} bytes; "
                    "read it with in_order=False"
                )

    def stats(self) -> dict[str, ChannelStats]:
        """Read the whole file once and count the messages of each topic."""
        tally = Tally(self.topics, self.header()[1])
        for entry in self.messages(in_order=False):
            tally.add(entry.topic, entry.message)
        return tally.channels

    def extras(self) -> Iterator[tuple[int, bytes]]:
        """Yield (opcode, body) of each attachment and metadata record."""
        yield from self._bodies(self.layout.extras)

    def _bodies(self, places: list[tuple[int, int, int]]) -> Iterator[tuple[int, bytes]]:
        for opcode, offset, length in places:
            if length > scan.MAX_RECORD_BYTES:
                self.layout.problems.append(f"byte {offset}: record of {length} bytes left out")
                continue
            self._file.seek(offset + records.RECORD_HEADER.size)
            yield opcode, self._file.read(length - records.RECORD_HEADER.size)

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the metadata records by name; damaged ones are left out."""
        found = {}
        for opcode, body in self.extras():
            if opcode == Opcode.METADATA:
                try:
                    record = Metadata.read(ReadDataStream(io.BytesIO(body)))
                except (McapError, struct.error, UnicodeDecodeError):
                    continue
                found[record.name] = record.metadata
        return found

    def header(self) -> tuple[str, str]:
        """Return profile and library of the header, both empty if it is damaged."""
        self._file.seek(len(records.MAGIC))
        try:
            for opcode, body in records.split(self._file.read(_HEADER_BYTES)):
                header = Header.read(ReadDataStream(io.BytesIO(body)))
                return (header.profile, header.library) if opcode == Opcode.HEADER else ("", "")
        except (BadRecord, McapError, struct.error, UnicodeDecodeError):
            pass
        return "", ""

    @property
    def lost_bytes(self) -> int:
        """Bytes in which nothing could be read so far, damaged chunks included."""
        return self.layout.skipped_bytes + sum(s.length for s in self._bad_segments)

    def _entry(self, message: Message) -> Entry:
        channel = self.channels[message.channel_id]
        return Entry(channel.topic, channel, message)

    def _wanted(
        self,
        message: Message,
        topics: Collection[str] | None,
        start_ns: int | None,
        end_ns: int | None,
    ) -> bool:
        channel = self.channels.get(message.channel_id)
        if channel is None:
            self._unknown[message.channel_id] = self._unknown.get(message.channel_id, 0) + 1
            return False
        return (
            (topics is None or channel.topic in topics)
            and (start_ns is None or message.log_time_ns >= start_ns)
            and (end_ns is None or message.log_time_ns < end_ns)
        )

    def _read_summary(self) -> bool:
        try:
            for opcode, body in scan.summary_records(self._file):
                self._define(opcode, body)
                if opcode == Opcode.STATISTICS:
                    self.statistics = records.parse_statistics(body)
        except BadRecord as error:
            self.layout.problems.append(f"summary: {error}")
            self.schemas.clear()
            self.channels.clear()
            return False
        return bool(self.channels) or not self.layout.segments

    def _define(self, opcode: int, body: bytes) -> None:
        if not self._open or opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        definition = records.parse_definition(opcode, body)
        if isinstance(definition, Schema):
            self.schemas.setdefault(definition.id, definition)
        else:
            self.channels.setdefault(definition.id, definition)

    def _segment(self, segment: Segment) -> Iterator[Message]:
        """Yield the messages of one segment up to the first damage, which is noted."""
        self._file.seek(segment.offset)
        data = self._file.read(segment.length)
        try:
            if segment.is_chunk:
                body = data[records.RECORD_HEADER.size :]
                data = records.decompress(records.parse_chunk(body))
            for opcode, body in records.split(data):
                if opcode == Opcode.MESSAGE:
                    yield records.parse_message(body)
                else:
                    self._define(opcode, body)
        except BadRecord as error:
            self._bad_segments[segment] = str(error)
