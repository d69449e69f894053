"""What a person sees of a running session, and how a person ends it."""

from __future__ import annotations

import contextlib
import shutil
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from types import FrameType

_EVERY_S = 0.2
_STEP_BACK = "\r\x1b[K"


class Status:
    """A line on stderr that is kept up to date by a thread: a slow terminal delays no tick."""

    def __init__(self, line: Callable[[], str]) -> None:
        """Start; ``line`` is called in the thread, and only where there is a terminal."""
        self._line, self._said = line, deque[str]()
        self._live = sys.stderr.isatty()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Print a line that stays; returns at once."""
        self._said.append(text)

    def close(self) -> None:
        """Print what is left, and end the live line."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(_EVERY_S):
            self._show()
        self._show()
        if self._live:
            print(_STEP_BACK, end="", file=sys.stderr, flush=True)

    def _show(self) -> None:
        back = _STEP_BACK if self._live else ""
        while self._said:
            print(f"{back}{self._said.popleft()}", file=sys.stderr, flush=True)
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            print(f"{back}{self._line()[:width]}", end="", file=sys.stderr, flush=True)


class StopSignal:
    """Whether somebody wants the session to end: Ctrl-C, a closed terminal, or ``kill``."""

    def __init__(self) -> None:
        self.given: signal.Signals | None = None
        """The signal that came."""

    def take(self, number: int, _: FrameType | None) -> None:
        """Note the signal; a second one breaks off whatever hangs."""
        if self.given:
            raise KeyboardInterrupt
        self.given = signal.Signals(number)


@contextlib.contextmanager
def stop_signals() -> Iterator[StopSignal]:
    """Let signals set a flag that the loop reads between two ticks, instead of breaking one off."""
    stop = StopSignal()
    before = {
        number: signal.signal(number, stop.take)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
