"""The process that talks to a UR controller: ``python -m eisp_data.robots.ur_link HOST HZ``.

It stands alone because ur_rtde keeps Python's lock while it waits, and when the connection is lost
it waits for ever: here that stops nobody else, and the process can be killed. It also keeps the
controller supplied every 8 ms however busy the policy is.

HZ is how often a target will come. Frames go both ways, each a letter, the length of what follows
(2 bytes) and that: to it ``L`` with 6 doubles (be there one control period from now) and ``H``
(halt); from it ``S`` with the state or ``E`` with a line on what went wrong. When its input ends or
its output is closed, it halts the arm and ends.
"""

from __future__ import annotations

import contextlib
import os
import struct
import sys
import threading
import time
from typing import IO

import numpy as np

STATE = struct.Struct("<13dB")
"""Controller's time, positions 6, velocities 6, and the bits below."""
TARGET = struct.Struct("<6d")
CONNECTED, PROTECTIVE_STOP, EMERGENCY_STOP, REFUSED = 1, 2, 4, 8

_HEADER = struct.Struct("<cH")
_STREAM_HZ = 125.0
"""Of a CB3 controller; an e-Series takes it as well."""
_WATCHDOG_HZ = 10.0
_LOOKAHEAD_S = 0.05
_GAIN = 300
_STOP_RAD_S2 = 8.0


def write_frame(stream: IO[bytes], kind: bytes, body: bytes = b"") -> None:
    """Send one frame; OSError if nobody listens."""
    stream.write(_HEADER.pack(kind, len(body)) + body)
    stream.flush()


def read_frame(stream: IO[bytes]) -> tuple[bytes, bytes] | None:
    """Return the next frame's letter and body, None at the end."""
    header = stream.read(_HEADER.size)
    if len(header) < _HEADER.size:
        return None
    kind, size = _HEADER.unpack(header)
    body = stream.read(size)
    return (kind, body) if len(body) == size else None


class _Wish:
    """What was asked for last, from the thread that reads."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.target: np.ndarray | None = None
        """(6,) rad; None is standing still."""
        self.asked_s = 0.0
        self.ended = False

    def listen(self, stream: IO[bytes]) -> None:
        """Take in frames until they end."""
        while (frame := read_frame(stream)) is not None:
            kind, body = frame
            with self.lock:
                self.target = np.array(TARGET.unpack(body)) if kind == b"L" else None
                self.asked_s = time.monotonic()
        with self.lock:
            self.target, self.ended = None, True


class _Leader:
    """Leads the arm on a straight line from one target to the next, and holds it at the last."""

    def __init__(self, control, receive, control_hz: float) -> None:
        self._control, self._receive = control, receive
        self._period_s = 1.0 / control_hz
        self._from: np.ndarray = np.zeros(6)
        self._to = self._from
        self._since_s = 0.0
        self._moving = False
        self.refused = False

    def step(self, target: np.ndarray | None, asked_s: float) -> None:
        """Do what one cycle of the controller needs."""
        if target is None:
            if self._moving:
                self._control.servoStop(_STOP_RAD_S2)
                self._moving = False
        else:
            self._lead(target, asked_s)
        self._control.kickWatchdog()

    def _lead(self, target: np.ndarray, asked_s: float) -> None:
        if asked_s != self._since_s or not self._moving:
            here = self._now() if self._moving else np.array(self._receive.getActualQ())
            self._from, self._to, self._since_s = here, target, asked_s
            self._moving = True
        accepted = self._control.servoJ(
            self._now().tolist(), 0.0, 0.0, 1 / _STREAM_HZ, _LOOKAHEAD_S, _GAIN
        )
        self.refused |= not accepted

    def _now(self) -> np.ndarray:
        share = min(1.0, (time.monotonic() - self._since_s) / self._period_s)
        return self._from + share * (self._to - self._from)


def _state(receive, refused: bool) -> bytes:
    bits = CONNECTED * receive.isConnected() | REFUSED * refused
    bits |= PROTECTIVE_STOP * receive.isProtectiveStopped()
    bits |= EMERGENCY_STOP * receive.isEmergencyStopped()
    values = [receive.getTimestamp(), *receive.getActualQ(), *receive.getActualQd()]
    return STATE.pack(*values, bits)


def _run(host: str, control_hz: float, commands: IO[bytes], states: IO[bytes]) -> None:
    from rtde_control import RTDEControlInterface
    from rtde_receive import RTDEReceiveInterface

    receive = RTDEReceiveInterface(host, _STREAM_HZ)
    control = RTDEControlInterface(host, _STREAM_HZ)
    # From here on the controller stops the arm by itself when this process falls silent.
    control.setWatchdog(_WATCHDOG_HZ)
    leader, wish = _Leader(control, receive, control_hz), _Wish()
    threading.Thread(target=wish.listen, args=(commands,), daemon=True).start()
    due = time.monotonic()
    while True:
        with wish.lock:
            target, asked_s, ended = wish.target, wish.asked_s, wish.ended
        try:
            write_frame(states, b"S", _state(receive, leader.refused))
        except OSError:
            # Nobody listens: the other end was killed.
            target, ended = None, True
        if ended and not receive.isConnected():
            return
        leader.step(target, asked_s)
        if ended:
            control.stopScript()
            return
        due = max(due + 1.0 / _STREAM_HZ, time.monotonic())
        time.sleep(due - time.monotonic() if due > time.monotonic() else 0.0)


def main() -> None:
    """Serve until the input ends."""
    host, control_hz = sys.argv[1], float(sys.argv[2])
    states = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # ur_rtde writes messages where the states go.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        _run(host, control_hz, sys.stdin.buffer, states)
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        with contextlib.suppress(OSError):
            write_frame(states, b"E", reason.encode()[:1000])
    # ur_rtde's own clean-up waits for a controller that may be gone.
    os._exit(0)


if __name__ == "__main__":
    main()
