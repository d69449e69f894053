"""Making a whole MCAP file of a damaged one, as a copy: the original is only ever read."""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer

from eisp_data.errors import DataError
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.tally import Tally


@dataclass(frozen=True)
class RepairReport:
    """What a repair kept and what it could not."""

    source: Path
    copy: Path
    messages: int
    """Messages in the copy."""
    duration_s: float
    """From the first to the last of them, in log time."""
    lost_bytes: int
    """Bytes of the source in which nothing could be read: damaged chunks and unknown matter."""
    missing: dict[str, int]
    """Topic to messages that the sequence numbers show to be absent."""
    problems: list[str]
    """What was wrong with the source, one line each."""

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        kept = f"kept {self.messages} messages over {self.duration_s:.2f} s in {self.copy}"
        lost = [f"lost {self.lost_bytes} bytes of {self.source}"] if self.lost_bytes else []
        gaps = [f"{topic}: {n} messages are missing" for topic, n in self.missing.items()]
        return [kept, *lost, *gaps, *(f"found: {problem}" for problem in self.problems)]


def repaired_path(source: Path) -> Path:
    """Return where ``repair`` puts the copy of ``source`` unless it is told."""
    return source.with_name(f"{source.stem}.repaired.mcap")


def repair(source: str | Path, copy: str | Path | None = None) -> RepairReport:
    """Write every message that can still be read from ``source`` into a new, indexed file.

    Payloads, times, sequence numbers and channels stay as they are. The copy appears under its
    name only when it is complete and on the disk. Raises DataError if ``source`` is no MCAP file,
    if nothing in it can be read, or if the copy exists already.
    """
    source = Path(source)
    copy = repaired_path(source) if copy is None else Path(copy)
    if copy.exists():
        raise DataError(f"{copy} exists already; a repair never overwrites a file")
    partial = copy.with_name(copy.name + ".partial")
    try:
        with McapLog(source) as log, partial.open("wb") as file:
            tally = _copy(log, file)
            read = [s for s in tally.channels.values() if s.count]
            if not read:
                raise DataError(f"{source}: no message in it can be read; nothing to repair")
            file.flush()
            os.fsync(file.fileno())
            first, last = min(s.first_ns for s in read), max(s.last_ns for s in read)
            report = RepairReport(
                source=source,
                copy=copy,
                messages=sum(s.count for s in read),
                duration_s=(last - first) / 1e9,
                lost_bytes=log.lost_bytes,
                missing=tally.missing(),
                problems=log.problems,
            )
        os.replace(partial, copy)
    except OSError as error:
        raise DataError(f"{copy}: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
    return report


def _copy(log: McapLog, file: IO[bytes]) -> Tally:
    """Write the readable part of ``log`` and return what was counted."""
    writer = Writer(file, compression=CompressionType.ZSTD)
    profile, library = log.header()
    writer.start(profile=profile, library=library)
    for opcode, body in log.extras():
        _copy_extra(writer, opcode, body, log)
    channels = _define(log, writer)
    tally = Tally(log.topics, library)
    for topic, _, m in log.messages(in_order=False):
        writer.add_message(
            channels[m.channel_id], m.log_time_ns, m.data, m.publish_time_ns, m.sequence
        )
        tally.add(topic, m)
    writer.finish()
    return tally


def _define(log: McapLog, writer: Writer) -> dict[int, int]:
    """Register all schemas and channels; returns the ids of the channels, old to new."""
    schemas = {
        number: writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, schema in log.schemas.items()
    }
    return {
        number: writer.register_channel(
            channel.topic,
            channel.message_encoding,
            schemas.get(channel.schema_id, 0),
            channel.metadata,
        )
        for number, channel in log.channels.items()
    }


def _copy_extra(writer: Writer, opcode: int, body: bytes, log: McapLog) -> None:
    """Copy an attachment or metadata record; one that cannot be parsed is noted as a problem."""
    stream = ReadDataStream(io.BytesIO(body))
    try:
        if opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            writer.add_metadata(metadata.name, metadata.metadata)
        else:
            found = Attachment.read(stream)
            writer.add_attachment(
                found.create_time, found.log_time, found.name, found.media_type, found.data
            )
    except (McapError, struct.error, UnicodeDecodeError):
        log.layout.problems.append(f"{Opcode(opcode).name.lower()} record cannot be read")
