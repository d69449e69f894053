"""What a recording holds, in a few lines."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from eisp_data.errors import DataError
from eisp_data.storage.mcap.collect import LAST_TIME_NS
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.resample import NANOSECONDS
from eisp_data.storage.mcap.writer import ROLE_KEY


def recordings(path: Path) -> list[Path]:
    """Return the MCAP files that ``path`` names: itself, or those in a folder (a ROS 2 bag).

    Raises DataError if there is no such file or folder, or if it is a bag of another kind; in a
    folder there may be none.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    refuse_sqlite(path)
    return sorted(path.glob("*.mcap")) if path.is_dir() else [path]


def refuse_sqlite(path: Path) -> None:
    """Raise DataError for a ROS 2 bag that is not MCAP, the default until Iron."""
    if path.suffix == ".db3" or (path.is_dir() and any(path.glob("*.db3"))):
        raise DataError(
            f"{path}: a ROS 2 bag in sqlite3; ros2 bag convert makes an MCAP of it (storage_id: "
            "mcap), and ros2 bag record -s mcap records one"
        )


def summary(path: Path) -> dict[str, Any]:
    """Return name and value of what one wants to know of a recording; plain JSON values.

    A file that was not ended is read from end to end, for nothing in it says what it holds.
    """
    with McapLog(path) as log:
        counts, start_ns, end_ns = _counts(log)
        profile, library = log.header()
        duration_s = (end_ns - start_ns) / NANOSECONDS
        channels = {}
        for topic, channel in sorted(log.topics.items()):
            schema = log.schema_of(channel)
            count = counts.get(topic, 0)
            channels[topic] = {
                "type": schema.name if schema else "",
                "messages": count,
                "mean_hz": round((count - 1) / duration_s, 2) if count > 1 and duration_s else 0.0,
                "role": channel.metadata.get(ROLE_KEY, ""),
            }
        return {
            "recording": path.name,
            "written_by": f"{library} {profile}".strip(),
            "session": log.metadata().get("session", {}),
            "start": _utc(start_ns),
            "duration_s": round(duration_s, 3),
            "messages": sum(counts.values()),
            "size_mb": round(path.stat().st_size / 1e6, 3),
            "problems": log.problems,
            "channels": channels,
        }


def _counts(log: McapLog) -> tuple[dict[str, int], int, int]:
    """Return topic to messages, and the first and the last log time in nanoseconds."""
    stated = log.statistics
    if stated is not None:
        counts: dict[str, int] = {}
        for number, count in stated.channel_message_counts.items():
            if number in log.channels:
                topic = log.channels[number].topic
                counts[topic] = counts.get(topic, 0) + count
        return counts, stated.message_start_time, stated.message_end_time
    found = {topic: stats for topic, stats in log.stats().items() if stats.count}
    first = min((stats.first_ns for stats in found.values()), default=0)
    last = max((stats.last_ns for stats in found.values()), default=0)
    return {topic: stats.count for topic, stats in found.items()}, first, last


def _utc(time_ns: int) -> str:
    seconds = min(time_ns, LAST_TIME_NS) / NANOSECONDS
    return datetime.fromtimestamp(seconds, UTC).isoformat(" ", "seconds")
