"""Workers to be killed: forked from a process that has imported everything already."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_SAY = """
import os, sys

def say(*words):
    # In one piece: parent and worker share the pipe.
    os.write(1, (" ".join(map(str, words)) + chr(10)).encode())
"""
_FORK = """
for _line in sys.stdin:
    _pid = os.fork()
    if not _pid:
        work(*_line.split())
        os._exit(0)
    say("pid", _pid)
    os.waitpid(_pid, 0)
    say("dead")
"""


class Nursery:
    """Starts one worker after the other; a kill costs no start-up. A context manager."""

    def __init__(self, code: str) -> None:
        """Run ``code``, which imports what is needed and defines ``work``.

        ``work(*words)`` says what it has done by ``say(*words)``, a line each.
        """
        paths = [str(folder) for folder in (Path(__file__).parent, Path(__file__).parent / "mcap")]
        start = f"{_SAY}\nsys.path[:0] = {paths!r}\n{code}\n{_FORK}"
        self._process = subprocess.Popen(
            [sys.executable, "-c", start],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._pid = 0

    def __enter__(self) -> Nursery:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def start(self, *words: object) -> None:
        """Fork a worker that does ``work(*words)``."""
        assert self._process.stdin is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()
        self._pid = 0

    def line(self) -> list[str]:
        """Wait for the next line of the worker and return its words; ``["dead"]`` at its end."""
        assert self._process.stdout is not None
        words = self._process.stdout.readline().split()
        if words and words[0] == "pid":
            self._pid = int(words[1])
            return self.line()
        assert words, "the nursery has ended"
        return words

    def kill(self) -> list[list[str]]:
        """Kill the worker with SIGKILL; return the lines that it had still said."""
        said = []
        while not self._pid:  # it may have said something before its number was
            said.append(self.line())
        if ["dead"] not in said:
            with suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)
            while (words := self.line()) != ["dead"]:
                said.append(words)
        return [words for words in said if words != ["dead"]]
