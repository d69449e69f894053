"""Counting the messages of a recording, and those that its sequence numbers show to be absent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from eisp_data.storage.mcap.records import Message

LIBRARY = "eisp-data"
"""What our recordings name as their writer: it counts each channel by itself."""


@dataclass
class ChannelStats:
    """What a full pass counted on one channel."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    jumped: int = 0
    """Numbers that were skipped from one message to the next."""
    fell: bool = False
    """A number was below the one before: several publishers, each with a count of its own."""
    last_sequence: int = -1

    def add(self, message: Message) -> None:
        """Count one message; calls come in the order of recording."""
        self.first_ns = message.log_time_ns if self.count == 0 else self.first_ns
        self.last_ns = max(self.last_ns, message.log_time_ns)
        # Many writers leave the sequence at 0; only a rising one says anything.
        if self.count and message.sequence > self.last_sequence:
            self.jumped += message.sequence - self.last_sequence - 1
        self.fell |= message.sequence < self.last_sequence
        self.last_sequence = message.sequence
        self.count += 1


class Tally:
    """What a full pass counts, by topic."""

    def __init__(self, topics: Iterable[str], library: str) -> None:
        """Begin a pass over a file with these topics, whose header names this library."""
        self.channels = {topic: ChannelStats() for topic in topics}
        self._ours = library == LIBRARY
        self._last = -1
        self._rising, self._mixed = True, False

    def add(self, topic: str, message: Message) -> None:
        """Count one message; calls come in the order of recording."""
        stats = self.channels[topic]
        self._rising &= message.sequence > self._last
        self._mixed |= 0 <= stats.last_sequence < self._last
        self._last = message.sequence
        stats.add(message)

    def missing(self) -> dict[str, int]:
        """Return topic to messages that were dropped or lost, where the numbers show any.

        They show none where a channel has no count of its own. That one count runs through the
        whole file is seen by numbers that only rise, while the channels take turns.
        """
        shared = self._rising and self._mixed
        return {
            topic: stats.jumped
            for topic, stats in self.channels.items()
            if stats.jumped and (self._ours or not (shared or stats.fell))
        }
