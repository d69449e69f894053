"""Checking an MCAP recording: every check by name, with its result and a line of detail."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.checks import Check
from eisp_data.storage.mcap import decode, pixels
from eisp_data.storage.mcap.reader import Entry, McapLog
from eisp_data.storage.mcap.resample import longest_usual_gap_ns
from eisp_data.storage.mcap.tally import Tally
from eisp_data.storage.mcap.windows import cut, started, unknown_words

STUCK_MESSAGES = 50
"""A sensor that has sent the very same reading this often, and never another, is stuck."""
LARGEST_LAG_S = 1.0
"""How far hardware and log time may differ."""
SUSPICIOUS = ("hardware times", "no gaps", "not stuck")
"""Checks that only warn: simulated time, a paused robot and an idle gripper are no damage."""


@dataclass
class _Seen:
    """What was seen of one channel."""

    times: array = field(default_factory=lambda: array("d"))
    """Log times in seconds."""
    backwards: int = 0
    largest_lag_s: float = 0.0
    not_finite: int = 0
    bad: str = ""
    """What is wrong with its first message that cannot be decoded."""
    first_value: bytes = b""
    changed: bool = False
    reading: bool = False
    """It carries readings of a sensor, which never repeat for long."""
    picture: decode.Picture | None = None


def checks(path: str | Path) -> list[Check]:
    """Read a recording from end to end and return all checks, in a fixed order.

    Raises DataError if ``path`` is missing or no MCAP file at all.
    """
    with McapLog(path) as log:
        seen: dict[str, _Seen] = {topic: _Seen() for topic in sorted(log.topics)}
        events: list[decode.Event] = []
        decoder = decode.Decoder()
        tally = Tally(log.topics, log.header()[1])
        for entry in log.messages(in_order=False):
            tally.add(entry.topic, entry.message)
            _look(log, decoder, entry, seen[entry.topic], events)
        return [
            _whole(log),
            _counts(log, seen),
            *_channels(seen, tally),
            _images(seen),
            _episodes(events, seen),
        ]


def _look(
    log: McapLog, decoder: decode.Decoder, entry: Entry, seen: _Seen, events: list[decode.Event]
) -> None:
    message = entry.message
    at = message.log_time_ns / 1e9
    seen.backwards += bool(seen.times) and at < seen.times[-1]
    seen.times.append(at)
    lag = abs(message.log_time_ns - message.publish_time_ns) / 1e9
    seen.largest_lag_s = max(seen.largest_lag_s, lag)
    schema = log.schema_of(entry.channel)
    if not decode.can_decode(schema):
        return
    try:
        decoded = decoder.decode(entry.channel, schema, message.data)
        if isinstance(decoded, decode.Picture) and seen.picture is None:
            pixels.rgb(decoded)
    except DataError as error:
        seen.bad = seen.bad or str(error)
        return
    if isinstance(decoded, decode.Event):
        events.append(decode.Event(message.publish_time_ns, decoded.kind, decoded.details))
        return
    if isinstance(decoded, decode.Picture):
        seen.picture = decoded
    seen.reading |= isinstance(decoded, decode.Picture | decode.Joints)
    value = _value(decoded)
    seen.not_finite += not np.isfinite(value).all()
    content = value.tobytes() if len(value) else getattr(decoded, "data", b"")
    seen.changed |= bool(seen.first_value) and content != seen.first_value
    seen.first_value = seen.first_value or content


def _value(decoded: decode.Decoded) -> np.ndarray:
    """Return all numbers of a message, (D,) float64; none for images and events."""
    if isinstance(decoded, decode.Joints):
        parts = [p for p in (decoded.position, decoded.velocity, decoded.effort) if p is not None]
        return np.concatenate(parts) if parts else np.zeros(0)
    if isinstance(decoded, decode.Poses):
        parts = [part for pose in decoded.poses for part in (pose.position, pose.orientation)]
        return np.concatenate(parts) if parts else np.zeros(0)
    return decoded.values if isinstance(decoded, decode.Vector) else np.zeros(0)


def _whole(log: McapLog) -> Check:
    found = log.problems
    if not found:
        return Check("whole", True, f"{len(log.layout.segments)} chunks pass their CRC, indexed")
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return Check("whole", False, f"{found[0]}{more}; `eisp-data repair` makes a whole copy")


def _counts(log: McapLog, seen: dict[str, _Seen]) -> Check:
    read = sum(len(s.times) for s in seen.values())
    if log.statistics is None:
        return Check("message count", not log.layout.ended, f"{read} read; none stated")
    stated = log.statistics.message_count
    return Check("message count", read == stated, f"{read} read, {stated} stated")


def _channels(seen: dict[str, _Seen], tally: Tally) -> Iterator[Check]:
    """Yield the checks that look at each channel and name those that fail."""
    by_channel = {
        "nothing dropped": {t: f"{n} missing" for t, n in sorted(tally.missing().items())},
        "log times rise": {t: f"{s.backwards} steps back" for t, s in seen.items() if s.backwards},
        "hardware times": {
            t: f"up to {s.largest_lag_s:.3g} s off log time"
            for t, s in seen.items()
            if s.largest_lag_s > LARGEST_LAG_S
        },
        "no gaps": {t: text for t, s in seen.items() if (text := _gap(s))},
        "decodable": {t: s.bad for t, s in seen.items() if s.bad},
        "finite": {
            t: f"{s.not_finite} messages with NaN or infinity"
            for t, s in seen.items()
            if s.not_finite
        },
        "not stuck": {
            t: f"{len(s.times)} times the same reading"
            for t, s in seen.items()
            if s.reading and not s.changed and len(s.times) >= STUCK_MESSAGES
        },
    }
    for name, failed in by_channel.items():
        detail = "; ".join(f"{topic}: {text}" for topic, text in failed.items())
        warning = bool(failed) and name in SUSPICIOUS
        yield Check(name, warning or not failed, detail or f"{len(seen)} channels", warning)
    rates = [f"{topic} {_rate(s):.1f} Hz" for topic, s in seen.items()]
    yield Check("rates", True, ", ".join(rates) or "no channels")


def _rate(seen: _Seen) -> float:
    times = np.frombuffer(seen.times) if seen.times else np.zeros(0)
    steps = np.diff(times)
    return 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0


def _gap(seen: _Seen) -> str:
    """Say where a channel that sends at a rate fell silent; it never does if it is irregular."""
    if len(seen.times) < 10 or not seen.reading:
        return ""
    times = np.sort(np.frombuffer(seen.times))
    steps = np.diff(times)
    worst = int(np.argmax(steps))
    if steps[worst] <= longest_usual_gap_ns(round(1e9 * np.median(steps))) / 1e9:
        return ""
    return f"silent for {steps[worst]:.2f} s from {times[worst] - times[0]:.2f} s on"


def _images(seen: dict[str, _Seen]) -> Check:
    bad, cameras = [], 0
    for topic, s in seen.items():
        if s.picture is not None:
            cameras += 1
            try:
                pixels.rgb(s.picture)
            except DataError as error:
                bad.append(f"{topic}: last {error}")
    return Check("images", not bad, "; ".join(bad) or f"first and last of {cameras} cameras open")


def _episodes(events: list[decode.Event], seen: dict[str, _Seen]) -> Check:
    begun, unknown = started(events), unknown_words(events)
    if not begun:
        return Check("episodes", not unknown, unknown or "no events: the whole recording is one")
    last = max(s.times[-1] for s in seen.values() if s.times)
    windows = cut(sorted(events, key=lambda event: event.time_ns or 0), 0, int(last * 1e9))
    complete = sum(window.complete for window in windows)
    success = sum(window.outcome == "success" for window in windows)
    detail = f"{begun} started, {complete} ended, {success} a success"
    detail += f"; {unknown}" if unknown else ""
    return Check("episodes", complete == begun, detail, bool(unknown))
