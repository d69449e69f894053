"""LeRobot's teleoperators as they answer while a hand moves them, without the device itself."""

from __future__ import annotations

from queue import Queue
from types import SimpleNamespace
from typing import Any

STAY, CLOSE = 1, 0


class HandOnGamepad:
    """Pushes the left stick half forward and to the left, closes the fingers, ends with success."""

    def __init__(self, reads: int, takes_over: bool = False) -> None:
        self.gamepad = SimpleNamespace(running=True)
        self.is_connected = True
        self._left, self._takes_over = reads, takes_over

    def connect(self) -> None:
        pass

    def get_action(self) -> dict[str, Any]:
        self._left -= 1
        return {"delta_x": 0.5, "delta_y": 0.25, "delta_z": 0.0, "gripper": CLOSE}

    def get_teleop_events(self) -> dict[str, bool]:
        return {"is_intervention": self._takes_over, "success": self._left < 0}

    def disconnect(self) -> None:
        self.is_connected = False


class HandOnKeyboard:
    """Holds the arrow up and ``s``; LeRobot has let go of the arrow down but not forgotten it."""

    def __init__(self) -> None:
        self.is_connected = True
        self.current_pressed = {"up": True, "down": False}
        self.misc_keys_queue: Queue[str] = Queue()

    def connect(self) -> None:
        pass

    def get_action(self) -> dict[str, Any]:
        self.misc_keys_queue.put("s")
        return {"delta_x": 0, "delta_y": -1, "delta_z": 0, "gripper": STAY}

    def disconnect(self) -> None:
        self.is_connected = False
