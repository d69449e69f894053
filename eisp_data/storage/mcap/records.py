"""The records of an MCAP file, parsed from bytes that may be damaged.

The parsers of the ``mcap`` package trust the lengths they read; a flipped bit there asks for
gigabytes. Here each length is checked against the bytes that exist before anything is allocated.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from eisp_data.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")
"""Opcode and length of what follows."""
CHUNK_HEADER = struct.Struct("<QQQII")
"""First and last log time, uncompressed size, CRC-32 of the uncompressed data, length of the name
of the compression."""
MESSAGE_HEADER = struct.Struct("<HIQQ")
"""Channel id, sequence, log time, publish time."""
FOOTER = struct.Struct("<QQI")
"""Start of the summary, start of the summary offsets, CRC-32 of the summary."""

MAX_CHUNK_BYTES = 256 * 2**20
"""The largest chunk that is read, compressed or not; recorders write 1 to 8 MiB."""
_ZSTD_WINDOW_BYTES = 128 * 2**20
"""What the highest level of compression may need, however small the chunk."""
COMPRESSIONS = (b"", b"lz4", b"zstd")


class BadRecord(Exception):
    """A record that cannot be what it claims to be; its text says why."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it lies in the file, times in nanoseconds."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk as it lies in the file: ``data`` is still compressed."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: bytes
    data: bytes


def chunk_header(body: bytes, length: int) -> tuple[int, int, int, int, bytes, int]:
    """Read the front of a chunk of ``length`` bytes of which ``body`` holds the first 64.

    Returns (first time, last time, uncompressed size, CRC, compression, offset of the data).
    A chunk whose parts do not add up to its length raises BadRecord.
    """
    if len(body) < CHUNK_HEADER.size + 8:
        raise BadRecord("chunk too short")
    start, end, size, crc, name_length = CHUNK_HEADER.unpack_from(body)
    at = CHUNK_HEADER.size
    name = body[at : at + name_length] if name_length <= 4 else None
    if name not in COMPRESSIONS:
        raise BadRecord("chunk of unknown compression (known: none, lz4, zstd)")
    at += name_length
    if len(body) < at + 8 or at + 8 + struct.unpack_from("<Q", body, at)[0] != length:
        raise BadRecord("chunk whose parts do not add up to its length")
    if max(length, size) > MAX_CHUNK_BYTES:
        raise BadRecord(f"chunk of {max(length, size)} bytes (limit {MAX_CHUNK_BYTES})")
    return start, end, size, crc, name, at + 8


def parse_chunk(body: bytes) -> Chunk:
    """Parse the whole body of a chunk record."""
    start, end, size, crc, compression, at = chunk_header(body[:64], len(body))
    return Chunk(start, end, size, crc, compression, body[at:])


def decompress(chunk: Chunk) -> bytes:
    """Return the records of a chunk, never more than the size it states, checked by its CRC."""
    if chunk.compression == b"":
        data = chunk.data
    elif chunk.compression == b"lz4":
        data = _lz4(chunk.data, chunk.size)
    else:
        data = _zstd(chunk.data, chunk.size)
    if len(data) != chunk.size:
        raise BadRecord(f"chunk holds {len(data)} bytes, states {chunk.size}")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise BadRecord("chunk fails its CRC")
    return data


def _lz4(data: bytes, size: int) -> bytes:
    import lz4.frame

    try:
        # The decoder sizes its buffer by the limit it is given, not by what the frame claims.
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, MemoryError) as error:
        raise BadRecord(f"lz4: {error}") from None


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    try:
        # One-shot decompression would allocate whatever the frame's own header claims.
        window = max(size, _ZSTD_WINDOW_BYTES)
        decoder = zstandard.ZstdDecompressor(max_window_size=window)
        with decoder.stream_reader(io.BytesIO(data), read_across_frames=True) as stream:
            return stream.read(size + 1)
    except (zstandard.ZstdError, MemoryError) as error:
        raise BadRecord(f"zstd: {error}") from None


def split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, body) of each record in ``data``; a record past the end raises BadRecord."""
    at = 0
    while at < len(data):
        if at + RECORD_HEADER.size > len(data):
            raise BadRecord("record header past the end")
        opcode, length = RECORD_HEADER.unpack_from(data, at)
        at += RECORD_HEADER.size
        if length > len(data) - at:
            raise BadRecord("record past the end")
        yield opcode, data[at : at + length]
        at += length


def parse_message(body: bytes) -> Message:
    """Parse the body of a message record."""
    if len(body) < MESSAGE_HEADER.size:
        raise BadRecord("message too short")
    channel, sequence, log_time_ns, publish_time_ns = MESSAGE_HEADER.unpack_from(body)
    return Message(channel, sequence, log_time_ns, publish_time_ns, body[MESSAGE_HEADER.size :])


def parse_statistics(body: bytes) -> Statistics:
    """Parse the body of a statistics record."""
    try:
        return Statistics.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error) as error:
        raise BadRecord(f"statistics: {error or 'cut short'}") from None


def parse_definition(opcode: int, body: bytes) -> Schema | Channel:
    """Parse the body of a schema or channel record."""
    stream = ReadDataStream(io.BytesIO(body))
    try:
        return (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise BadRecord(f"{Opcode(opcode).name.lower()}: {error or 'cut short'}") from None


def check_magic(head: bytes, path: object) -> None:
    """Raise DataError unless ``head``, the first bytes of a file, are those of MCAP version 0."""
    if head[: len(MAGIC)] == MAGIC:
        return
    if not head:
        raise DataError(f"{path}: empty file, not an MCAP recording")
    if head[:5] == MAGIC[:5]:
        raise DataError(f"{path}: MCAP of version {head[5:6]!r}, only version b'0' can be read")
    raise DataError(f"{path}: not an MCAP file (it starts with {head[:8]!r})")
