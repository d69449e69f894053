"""A human at the controls, through LeRobot's teleoperators for the keyboard and for gamepads.

========  =====================================  ==================================
what      keyboard                               gamepad
========  =====================================  ==================================
move      arrow keys                             left stick
up, down  right shift, left shift                right stick
fingers   right ctrl opens, left ctrl closes     RT opens, LT closes
outcome   s success, q failure, r record again   Y success, A failure, X again
take over any of the keys that move              RB (or R1)
========  =====================================  ==================================
"""

from __future__ import annotations

import contextlib
import logging
import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

import numpy as np

from eisp_data.errors import ConfigError, RobotError

Device = Literal["keyboard", "gamepad"]
_OUTCOMES = {"s": "success", "q": "failure", "r": "discard"}
_FINGERS = {0: -1.0, 2: 1.0}
"""LeRobot's closing and opening; its 1 leaves the fingers as they are."""


@dataclass(frozen=True)
class Grip:
    """What the human does right now."""

    motion: np.ndarray
    """(3,) in [-1, 1]: forward, left, up, in shares of the fastest displacement."""
    fingers: float | None
    """-1 closes, 1 opens, None leaves them as they are."""
    takes_over: bool
    """The human wants the robot, whatever a policy says."""
    outcome: str | None
    """How the episode ended, if it did: success, failure or discard."""


class Teleop:
    """One LeRobot teleoperator, read once per tick."""

    def __init__(self, device: Device) -> None:
        """Open the device.

        Raises:
            ConfigError: the library for it is not installed.
            RobotError: there is no such device, or its keys cannot be read here.
        """
        self.device = device
        self._source: Any = _make(device)
        self._held: set[str] = set()
        with _silence():
            self._source.connect()
        if not self._connected():
            self.close()
            raise RobotError(
                "gamepad: none is plugged in; plug one in, or use the keyboard"
                if device == "gamepad"
                else "keyboard: its keys cannot be read here, which takes an X11 session, Windows "
                "or macOS; use a gamepad"
            )

    def read(self) -> Grip:
        """Return what the human does.

        Raises:
            RobotError: the device is gone, or the human pressed escape.
        """
        if not self._connected():
            raise RobotError(f"{self.device}: disconnected")
        said = self._source.get_action()
        if self.device == "keyboard":
            # LeRobot's arms face the other way: its up is minus y, its left is x.
            motion = np.array([-said["delta_y"], said["delta_x"], said["delta_z"]], float)
            outcome = self._pressed_outcome()
            takes_over = bool(motion.any()) or said["gripper"] in _FINGERS
            # A key that was let go of would undo its opposite for as long as LeRobot keeps it.
            held = {key: True for key, down in self._source.current_pressed.items() if down}
            self._source.current_pressed = held
        else:
            motion = np.array([said["delta_x"], said["delta_y"], said["delta_z"]], float)
            events = self._source.get_teleop_events()
            outcome = _outcome(events)
            takes_over = bool(events["is_intervention"])
        return Grip(np.clip(motion, -1, 1), _FINGERS.get(int(said["gripper"])), takes_over, outcome)

    def close(self) -> None:
        """Let go of the device; safe to call twice."""
        if self._source.is_connected:
            self._source.disconnect()

    def _connected(self) -> bool:
        if self.device == "gamepad":
            pad = self._source.gamepad
            return pad is not None and pad.running
        return bool(self._source.is_connected)

    def _pressed_outcome(self) -> str | None:
        """Return the outcome of a key that has just been pressed; held keys count once."""
        down: set[str] = set()
        while not self._source.misc_keys_queue.empty():
            down.add(self._source.misc_keys_queue.get_nowait())
        fresh, self._held = down - self._held, down
        return next((outcome for key, outcome in _OUTCOMES.items() if key in fresh), None)


def _make(device: Device) -> Any:
    """Return LeRobot's teleoperator, not yet connected."""
    try:
        if device == "keyboard":
            from lerobot.teleoperators.keyboard import (
                KeyboardEndEffectorTeleop,
                KeyboardEndEffectorTeleopConfig,
            )

            return KeyboardEndEffectorTeleop(KeyboardEndEffectorTeleopConfig())
        _quiet_pygame()
        from lerobot.teleoperators.gamepad import GamepadTeleop, GamepadTeleopConfig

        return GamepadTeleop(GamepadTeleopConfig())
    except ImportError:
        raise ConfigError(f"{device}: not installed; pip install 'eisp[teleop]'") from None


def _quiet_pygame() -> None:
    """Import pygame, which LeRobot needs once it connects, without greeting, sound or window."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings(action="ignore"):
        import_module("pygame")


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep back what LeRobot logs about a missing device: an error says it in one line."""
    logging.disable(logging.ERROR)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def _outcome(events: dict[Any, Any]) -> str | None:
    """Return what LeRobot's events say of the episode; its keys are strings or an enum of them."""
    said = {str(getattr(key, "value", key)): value for key, value in events.items()}
    if said.get("rerecord_episode"):
        return "discard"
    if said.get("success"):
        return "success"
    return "failure" if said.get("terminate_episode") else None
