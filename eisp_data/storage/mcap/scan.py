"""Finding what can be read in an MCAP file, whole or damaged, without trusting its index.

One path serves healthy, cut-off and damaged files: walk from record to record by their headers and
note where messages lie. Where the walk hits nonsense it looks for the next chunk by its shape.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from mcap.opcode import Opcode

from eisp_data.storage.mcap import records
from eisp_data.storage.mcap.records import BadRecord

LOOSE_SEGMENT_BYTES = 2**20
"""How much of a file without chunks is read at once."""
MAX_RECORD_BYTES = 2**31
"""The largest single attachment or loose message that is read."""
_SEARCH_BYTES = 2**20
_CHUNK_SHAPE = re.compile(
    rb"\x06[\s\S]{5}\x00\x00\x00[\s\S]{28}(?:\x00{4}|\x03\x00{3}lz4|\x04\x00{3}zstd)"
)
"""Opcode, a length below 2**40, times, size, CRC, one of the three names of compression."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of the file with messages: one chunk, or a run of records outside any chunk."""

    offset: int
    length: int
    is_chunk: bool
    start_ns: int
    end_ns: int


@dataclass
class Layout:
    """What a walk through the file found."""

    segments: list[Segment] = field(default_factory=list)
    extras: list[tuple[int, int, int]] = field(default_factory=list)
    """(opcode, offset, length) of each attachment and metadata record."""
    definitions: list[tuple[int, int, int]] = field(default_factory=list)
    """(opcode, offset, length) of the schemas and channels that the summary repeats."""
    problems: list[str] = field(default_factory=list)
    skipped_bytes: int = 0
    """Bytes in which nothing could be recognised."""
    ended: bool = False
    """The data section was finished; what follows is the summary."""


def walk(file: BinaryIO) -> Layout:
    """Walk through ``file`` (opened for reading, magic already checked)."""
    layout, loose = Layout(), _Loose()
    size = os.fstat(file.fileno()).st_size
    at = trusted = len(records.MAGIC)
    while at < size and not layout.ended:
        try:
            opcode, length = _header(file, at, size)
            end = at + records.RECORD_HEADER.size + length
            if opcode == Opcode.MESSAGE:
                loose.add(file, at, end, layout)
            elif opcode == Opcode.CHUNK:
                loose.close(layout)
                start_ns, end_ns, *_ = records.chunk_header(file.read(64), length)
                layout.segments.append(Segment(at, end - at, True, start_ns, end_ns))
                trusted = end
            elif opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                layout.extras.append((opcode, at, end - at))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                loose.extend(at, end, layout)
            layout.ended = opcode == Opcode.DATA_END
            at = end
        except BadRecord as error:
            loose.close(layout)
            layout.problems.append(f"byte {at}: {error}")
            # A wrong length may have carried the walk past good chunks: search from the last
            # place that was certain.
            found = _next_chunk(file, trusted, size)
            layout.skipped_bytes += max(found - at, 0)
            layout.segments = [s for s in layout.segments if s.offset < found]
            at = trusted = found
    loose.close(layout)
    if not layout.ended:
        layout.problems.append("no end of data: the recording was cut off")
    _note_definitions(file, at, size, layout)
    return layout


def _note_definitions(file: BinaryIO, at: int, size: int, layout: Layout) -> None:
    """Note what the summary repeats: its own offsets may be wrong, and a first chunk lost."""
    try:
        while at < size:
            opcode, length = _header(file, at, size)
            end = at + records.RECORD_HEADER.size + length
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                layout.definitions.append((opcode, at, end - at))
            at = end
    except BadRecord:
        pass  # The summary's own reader says what is wrong with it.


def _header(file: BinaryIO, at: int, size: int) -> tuple[int, int]:
    file.seek(at)
    head = file.read(records.RECORD_HEADER.size)
    if len(head) < records.RECORD_HEADER.size:
        raise BadRecord("record cut off")
    opcode, length = records.RECORD_HEADER.unpack(head)
    if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 0x80):
        raise BadRecord(f"no record has opcode {opcode:#04x}")
    if length > size - at - len(head):
        raise BadRecord(f"{_name(opcode)} record cut off")
    return opcode, length


def _name(opcode: int) -> str:
    return Opcode(opcode).name.lower().replace("_", " ") if opcode < 0x80 else "private"


def _next_chunk(file: BinaryIO, start: int, size: int) -> int:
    """Return the offset of the first whole chunk at or after ``start``, or ``size``."""
    at, overlap = start, 64
    while at < size:
        file.seek(at)
        block = file.read(_SEARCH_BYTES + overlap)
        for match in _CHUNK_SHAPE.finditer(block):
            offset = at + match.start()
            if _is_chunk(file, offset, size):
                return offset
        at += _SEARCH_BYTES
    return size


def _is_chunk(file: BinaryIO, offset: int, size: int) -> bool:
    try:
        opcode, length = _header(file, offset, size)
        records.chunk_header(file.read(64), length)
    except BadRecord:
        return False
    return opcode == Opcode.CHUNK


class _Loose:
    """Gathers neighbouring records outside chunks into segments of a bounded size."""

    def __init__(self) -> None:
        self.start = self.end = 0
        self.first_ns: int | None = None
        self.last_ns = 0

    def add(self, file: BinaryIO, at: int, end: int, layout: Layout) -> None:
        """Take in the message record at ``at``, whose header has just been read."""
        head = file.read(records.MESSAGE_HEADER.size)
        if end - at < records.RECORD_HEADER.size + records.MESSAGE_HEADER.size:
            raise BadRecord("message too short")
        if end - at > MAX_RECORD_BYTES:
            raise BadRecord(f"message of {end - at} bytes (limit {MAX_RECORD_BYTES})")
        log_time_ns = records.parse_message(head).log_time_ns
        if end - self.start > LOOSE_SEGMENT_BYTES:
            self.close(layout)
        self.extend(at, end, layout)
        self.first_ns = log_time_ns if self.first_ns is None else min(self.first_ns, log_time_ns)
        self.last_ns = max(self.last_ns, log_time_ns)

    def extend(self, at: int, end: int, layout: Layout) -> None:
        """Take in the record from ``at`` to ``end``, after a gap as a new segment."""
        if at != self.end:
            self.close(layout)
            self.start = at
        self.end = end

    def close(self, layout: Layout) -> None:
        """End the segment, if there is one."""
        if self.end > self.start:
            first = 0 if self.first_ns is None else self.first_ns
            layout.segments.append(
                Segment(self.start, self.end - self.start, False, first, self.last_ns)
            )
        self.start = self.end
        self.first_ns, self.last_ns = None, 0


def summary_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, body) of the summary at the end of ``file``; raises BadRecord if it is bad.

    A file without a summary, as a recorder leaves it that was killed, raises as well.
    """
    tail = records.RECORD_HEADER.size + records.FOOTER.size + len(records.MAGIC)
    size = os.fstat(file.fileno()).st_size
    if size < tail + len(records.MAGIC):
        raise BadRecord("no footer")
    file.seek(size - tail)
    end = file.read(tail)
    opcode, length = records.RECORD_HEADER.unpack_from(end)
    whole = opcode == Opcode.FOOTER and length == records.FOOTER.size
    if not whole or not end.endswith(records.MAGIC):
        raise BadRecord("no footer")
    start, _, crc = records.FOOTER.unpack_from(end, records.RECORD_HEADER.size)
    if start == 0:
        raise BadRecord("no summary")
    if start > size - tail or size - tail - start > records.MAX_CHUNK_BYTES:
        raise BadRecord("summary outside the file")
    file.seek(start)
    body = file.read(size - tail - start)
    checked = body + end[: -len(records.MAGIC) - struct.calcsize("<I")]
    if crc and zlib.crc32(checked) != crc:
        raise BadRecord("summary fails its CRC")
    yield from records.split(body)
