"""The part of the rosbridge protocol (version 2) that a robot's driver needs, over a websocket."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from typing import Any

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from eisp_data.errors import RobotError

PORT = 9090
_TIMEOUT_S = 5.0
_LARGEST = 2**25
"""Bytes of a message: an image has room."""


class Rosbridge:
    """One connection; a thread keeps the newest message of each topic."""

    def __init__(self, host: str) -> None:
        """Prepare for a rosbridge server at ``host`` or ``host:port``."""
        self.host = host if ":" in host else f"{host}:{PORT}"
        self._link: ClientConnection | None = None
        self._opened = contextlib.ExitStack()
        self._newest: dict[str, tuple[dict[str, Any], float, int]] = {}
        self._fault: str | None = None

    def connect(self) -> None:
        """Connect; RobotError if nothing answers."""
        try:
            opening = connect(f"ws://{self.host}", open_timeout=_TIMEOUT_S, max_size=_LARGEST)
            self._link = self._opened.enter_context(opening)
        except (OSError, WebSocketException) as error:
            reason = getattr(error, "strerror", None) or str(error) or "it does not answer"
            raise RobotError(f"no rosbridge at {self.host}: {reason}") from None
        self._fault = None
        self._newest.clear()
        threading.Thread(target=self._listen, args=(self._link,), daemon=True).start()

    def subscribe(self, topic: str, kind: str) -> None:
        """Ask for the newest messages of a topic."""
        self._send(op="subscribe", topic=topic, type=kind, queue_length=1)

    def advertise(self, topic: str, kind: str) -> None:
        """Announce what will be published."""
        self._send(op="advertise", topic=topic, type=kind)

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Send a message; RobotError if the connection is lost."""
        self._send(op="publish", topic=topic, msg=message)

    def newest(self, topic: str) -> tuple[dict[str, Any], float, int] | None:
        """Return a topic's newest message, when it arrived and its number; None before the first.

        Raises:
            RobotError: the connection is lost, or the server reports an error.
        """
        if self._link is None:
            raise RobotError("rosbridge is not connected")
        if self._fault:
            raise RobotError(self._fault)
        return self._newest.get(topic)

    def wait_for(self, topic: str) -> dict[str, Any]:
        """Return the first message of a topic; RobotError if none comes."""
        until = time.monotonic() + _TIMEOUT_S
        while (found := self.newest(topic)) is None:
            if time.monotonic() > until:
                raise RobotError(f"{self.host} publishes nothing on {topic}")
            time.sleep(0.01)
        return found[0]

    def disconnect(self) -> None:
        """Close; safe to call twice, or unconnected."""
        self._link = None
        with contextlib.suppress(OSError, WebSocketException):
            self._opened.close()

    def _send(self, **message: Any) -> None:
        if self._link is None:
            raise RobotError("rosbridge is not connected")
        try:
            self._link.send(json.dumps(message))
        except (OSError, WebSocketException):
            raise RobotError(f"the connection to rosbridge at {self.host} is lost") from None

    def _listen(self, link: ClientConnection) -> None:
        with contextlib.suppress(OSError, WebSocketException):
            for text in link:
                message = json.loads(text)
                if message.get("op") == "publish":
                    before = self._newest.get(message["topic"])
                    number = 0 if before is None else before[2] + 1
                    self._newest[message["topic"]] = message["msg"], time.monotonic(), number
                elif message.get("op") == "status" and message.get("level") == "error":
                    self._fault = f"rosbridge at {self.host}: {message.get('msg')}"
        self._fault = self._fault or f"the connection to rosbridge at {self.host} is lost"
