"""A Robotiq 2F gripper on the socket of its URCap: lines of text on port 63352.

``SET ACT 1`` answers ``ack``, ``GET POS`` answers ``POS 137``; positions run from 0, open, to 255,
closed, though a gripper with fingertips reaches a part of them only.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time

from eisp_data.errors import RobotError

PORT = 63352
_TIMEOUT_S = 2.0
_ACTIVE = 3
_ACTIVATION_S = 8.0
_SETTLE_S = 6.0
_POLL_S = 0.03
_FORCE = 60
"""Of 255: enough for a block of wood."""


class RobotiqGripper:
    """One gripper; a thread keeps its position, so that nothing waits for the socket."""

    def __init__(self, host: str, opening_m: float) -> None:
        """Prepare for the gripper of the controller at that address, this wide when open."""
        self._host, self._opening_m = host, opening_m
        self._open_at, self._closed_at = 3, 228
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._position = self._target = 0
        self._active = False
        self._fault: str | None = None

    def connect(self) -> None:
        """Connect; RobotError if nothing answers. The fingers stay where they are."""
        try:
            self._socket = socket.create_connection((self._host, PORT), timeout=_TIMEOUT_S)
        except OSError as error:
            reason = error.strerror or error
            raise RobotError(f"no gripper at {self._host}:{PORT}: {reason}") from None
        self._active = self._get("STA") == _ACTIVE
        self._position = self._target = self._get("POS")
        self._fault = None
        self._closing.clear()
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()

    def calibrate(self) -> None:
        """Activate it if it is not, and open and close it once to find the ends of its range."""
        if not self._active:
            self._set("ACT 1")
            self._await("STA", _ACTIVE, _ACTIVATION_S)
            self._active = True
        self._open_at = self._move_and_wait(0)
        self._closed_at = self._move_and_wait(255)
        if self._closed_at - self._open_at < 20:
            raise RobotError(
                f"the gripper moves from {self._open_at} to {self._closed_at} of 255 only:"
                " something is in its way"
            )
        self._move_and_wait(self._open_at)

    def opening_m(self) -> float:
        """Return how far it is open; RobotError if it no longer answers."""
        if self._fault:
            raise RobotError(self._fault)
        return self._to_m(self._position)

    def move(self, opening_m: float) -> float:
        """Start to move to that opening; return the one in its own resolution.

        Raises:
            RobotError: it is not active.
        """
        if not self._active:
            raise RobotError(
                "the gripper is not active: activate it on the teach pendant, or call calibrate, "
                "which moves its fingers"
            )
        share = min(1.0, max(0.0, opening_m / self._opening_m))
        self._target = round(self._closed_at + share * (self._open_at - self._closed_at))
        return self._to_m(self._target)

    def disconnect(self) -> None:
        """Stop where it is and close; safe to call twice, or unconnected."""
        self._closing.set()
        if self._socket is None:
            return
        with contextlib.suppress(RobotError):
            self._set("GTO 0")
        with contextlib.suppress(OSError):
            self._socket.close()
        self._socket = None

    def _to_m(self, position: int) -> float:
        share = (self._closed_at - position) / (self._closed_at - self._open_at)
        return self._opening_m * min(1.0, max(0.0, share))

    def _move_and_wait(self, position: int) -> int:
        self._target = position
        until = time.monotonic() + _SETTLE_S
        before = -1
        while time.monotonic() < until:
            time.sleep(5 * _POLL_S)
            if self._fault:
                raise RobotError(self._fault)
            if self._position == before:
                break
            before = self._position
        return self._position

    def _poll(self) -> None:
        sent = self._target
        while not self._closing.wait(_POLL_S):
            try:
                if self._target != sent:
                    sent = self._target
                    self._set(f"POS {sent} SPE 255 FOR {_FORCE} GTO 1")
                self._position = self._get("POS")
            except RobotError as error:
                self._fault = str(error)
                return

    def _await(self, name: str, value: int, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (now := self._get(name)) != value:
            if time.monotonic() > until:
                raise RobotError(f"the gripper's {name} stays {now}, {value} is wanted")
            time.sleep(_POLL_S)

    def _set(self, what: str) -> None:
        answer = self._ask(f"SET {what}")
        if answer != "ack":
            raise RobotError(f"the gripper answers {answer!r} to {what!r}")

    def _get(self, name: str) -> int:
        answer = self._ask(f"GET {name}")
        key, _, value = answer.partition(" ")
        if key != name or not value.isdigit():
            raise RobotError(f"the gripper answers {answer!r} to GET {name}")
        return int(value)

    def _ask(self, line: str) -> str:
        with self._lock:
            link = self._socket
            if link is None:
                raise RobotError("the gripper is not connected")
            try:
                link.sendall(f"{line}\n".encode("ascii"))
                answer = link.recv(1024)
            except OSError as error:
                raise RobotError(f"the gripper at {self._host} is lost: {error}") from None
            if not answer:
                raise RobotError(f"the gripper at {self._host} is lost: it closed the connection")
            return answer.decode("ascii", "replace").strip()
