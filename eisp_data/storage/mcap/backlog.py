"""The bounded queue between a control loop, which must never wait, and a disk, which may stall."""

from __future__ import annotations

import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Item:
    """Something to be written: a message, or an image still to be compressed."""

    topic: str
    payload: Any
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    size: int
    """Bytes it keeps in memory."""


class Backlog:
    """Items waiting to be written, at most ``limit_bytes`` of them.

    Bulky items (images) may fill three quarters of it; the rest is kept for the small messages,
    so that a stalled disk costs images first, and commands and events last. What does not fit
    is refused and counted by topic.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self._items: deque[Item] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closed = False
        self.dropped: Counter[str] = Counter()
        """Topic to messages refused since the start."""

    @property
    def waiting_bytes(self) -> int:
        """How much is in memory now."""
        return self._bytes

    def put(self, item: Item, bulky: bool) -> bool:
        """Add ``item`` without waiting; return False, and count it, if there is no room."""
        limit = self.limit_bytes * 3 // 4 if bulky else self.limit_bytes
        with self._changed:
            if self._closed or self._bytes + item.size > limit:
                self.dropped[item.topic] += 1
                return False
            self._items.append(item)
            self._bytes += item.size
            self._changed.notify()
            return True

    def add(self, item: Item) -> None:
        """Add what takes no room and is never refused, from the thread that writes."""
        with self._changed:
            self._items.append(item)

    def take(self, timeout_s: float) -> list[Item] | None:
        """Return what is waiting, an empty list after ``timeout_s``, None once closed and empty."""
        with self._changed:
            if not self._items and not self._closed:
                self._changed.wait(timeout_s)
            items = list(self._items)
            self._items.clear()
            return items if items or not self._closed else None

    def done(self, item: Item) -> None:
        """Give the room of an item back, which is only now out of memory."""
        with self._changed:
            self._bytes -= item.size

    def close(self) -> None:
        """Refuse everything from now on; what is waiting can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()
