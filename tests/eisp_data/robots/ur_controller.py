"""A stand-in for a UR controller (CB3, PolyScope 3.15) with a Robotiq gripper, on loopback.

It speaks what ur_rtde and the gripper's driver use: RTDE version 2 on port 30004, the script port
30003, the dashboard 29999 and the gripper's 63352. The program that ur_rtde uploads is not run but
taken for what it is known to do: ``servoJ`` moves the arm, every other command is done at once.

It needs a process of its own, because ur_rtde does not let go of the interpreter while it waits:
``python ur_controller.py HOST JOINTS`` answers each line on its input with a line of JSON.
"""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import sys
import threading
import time
from functools import partial

import numpy as np

RTDE, SCRIPT, DASHBOARD, GRIPPER = 30004, 30003, 29999, 63352
READY, DONE = 1, 2
SERVOJ, SERVO_STOP, SET_WATCHDOG, STOP_SCRIPT = 11, 16, 35, 255
JOINT_SPEED = 3.0
_FORMATS = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "UINT8": "B"}
_FORMATS |= {"VECTOR6D": "6d", "VECTOR3D": "3d", "VECTOR6INT32": "6i", "BOOL": "?"}
_VECTORS = ("actual_q", "actual_qd", "target", "actual_current", "joint_control", "joint_temp")
_VECTORS += ("actual_TCP", "actual_joint_voltage", "ft_raw")
_TYPES = {
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "joint_mode": "VECTOR6INT32",
    "target_speed_fraction": "DOUBLE",
    "actual_tool_accelerometer": "VECTOR3D",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    "speed_slider_mask": "UINT32",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
}


def type_of(name: str) -> str:
    """Return the type of an RTDE variable as the protocol's tables have it."""
    if name in _TYPES:
        return _TYPES[name]
    if "int_register" in name:
        return "INT32"
    if name.startswith(_VECTORS):
        return "VECTOR6D"
    return "DOUBLE"


class UrController:
    """Listens at one loopback address.

    Attributes:
        joints: (6,) rad, where the arm is.
        commands: the numbers of the commands that arrived, in order.
        script: what was uploaded.
        lines: what the gripper was told.
    """

    def __init__(self, host: str, joints: np.ndarray) -> None:
        self.host, self.joints, self.velocity = host, np.array(joints), np.zeros(6)
        self.commands: list[int] = []
        self.lines: list[str] = []
        self.script = ""
        self.protective_stop = False
        self.gripper = {"ACT": 1, "STA": 3, "GTO": 0, "POS": 3, "PRE": 3, "OBJ": 0, "FLT": 0}
        self._gripper_range = (3, 228)
        self._registers: dict[str, float] = {}
        self._program_running = False
        self._target: np.ndarray | None = None
        self._state = READY
        self._heard = self._patience = np.inf
        self._started = time.monotonic()
        self._lock = threading.Lock()
        for port, serve in (
            (RTDE, self._serve_rtde),
            (SCRIPT, self._serve_script),
            (DASHBOARD, self._serve_dashboard),
            (GRIPPER, self._serve_gripper),
        ):
            self._listen(port, serve)
        threading.Thread(target=self._move, daemon=True).start()

    def _listen(self, port, serve):
        listener = socket.create_server((self.host, port))

        def accept():
            while True:
                link, _ = listener.accept()
                threading.Thread(target=self._quietly, args=(serve, link), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()

    def _quietly(self, serve, link):
        with contextlib.suppress(OSError, ConnectionError):
            serve(link)

    def _move(self):
        period = 0.008
        while True:
            time.sleep(period)
            with self._lock:
                if time.monotonic() - self._heard > self._patience:
                    self._program_running, self._target = False, None
                before = self.joints.copy()
                if self._target is not None:
                    way = np.clip(
                        self._target - before, -JOINT_SPEED * period, JOINT_SPEED * period
                    )
                    self.joints = before + way
                self.velocity = (self.joints - before) / period
                low, high = self._gripper_range
                goal = int(np.clip(self.gripper["PRE"], low, high))
                self.gripper["POS"] += int(np.clip(goal - self.gripper["POS"], -4, 4))

    def _serve_rtde(self, link):
        inputs: list[list[str]] = []
        outputs: list[str] = []
        while True:
            size, kind = struct.unpack(">HB", _exactly(link, 3))
            body = _exactly(link, size - 3)
            if kind == ord("V"):
                _send(link, kind, struct.pack(">B", struct.unpack(">H", body)[0] == 2))
            elif kind == ord("v"):
                _send(link, kind, struct.pack(">4I", 3, 15, 8, 106339))
            elif kind == ord("O"):
                outputs = body[8:].decode().strip(",").split(",")
                _send(link, kind, b"\x01" + ",".join(map(type_of, outputs)).encode())
            elif kind == ord("I"):
                inputs.append(body.decode().strip(",").split(","))
                types = ",".join(map(type_of, inputs[-1])).encode()
                _send(link, kind, bytes([len(inputs)]) + types)
            elif kind == ord("S"):
                _send(link, kind, b"\x01")
                publish = partial(self._publish, names=outputs)
                threading.Thread(target=self._quietly, args=(publish, link), daemon=True).start()
            elif kind == ord("P"):
                _send(link, kind, b"\x01")
            elif kind == ord("U"):
                names = inputs[body[0] - 1]
                pattern = ">" + "".join(_FORMATS[type_of(name)] for name in names)
                self._take(dict(zip(names, struct.unpack(pattern, body[1:]), strict=True)))

    def _publish(self, link, names):
        pattern = ">B" + "".join(_FORMATS[type_of(name)] for name in names)
        while True:
            values: list[float] = [1]
            with self._lock:
                for name in names:
                    value = np.atleast_1d(self._output(name))
                    values += value.tolist()
            _send(link, ord("U"), struct.pack(pattern, *values))
            time.sleep(0.008)

    def _output(self, name):
        kind = type_of(name)
        known = {
            "timestamp": 1000.0 + time.monotonic() - self._started,
            "actual_q": self.joints,
            "actual_qd": self.velocity,
            "robot_status_bits": 0b1 | (0b10 if self._program_running else 0),
            "safety_status_bits": 0b100 if self.protective_stop else 0b1,
            "runtime_state": 2 if self._program_running else 1,
            "robot_mode": 7,
            "safety_mode": 3 if self.protective_stop else 1,
            "output_int_register_0": self._state if self._program_running else 0,
        }
        if name in known:
            return known[name]
        count = {"VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR3D": 3}.get(kind, 1)
        return np.zeros(count, float if kind in ("DOUBLE", "VECTOR6D", "VECTOR3D") else int)

    def _take(self, values):
        with self._lock:
            self._registers |= values
            self._heard = time.monotonic()
            command = int(values.get("input_int_register_0", 0))
            if not command:
                self._state = READY
                return
            self.commands.append(command)
            if command == SERVOJ:
                self._target = np.array(
                    [self._registers[f"input_double_register_{i}"] for i in range(6)]
                )
                return
            if command == SERVO_STOP:
                self._target = None
            if command == SET_WATCHDOG:
                # Five times that of a real one: a machine that runs tests may be slow.
                self._patience = 5.0 / self._registers["input_double_register_0"]
            if command == STOP_SCRIPT:
                self._program_running, self._target = False, None
            self._state = DONE

    def _serve_script(self, link):
        while received := link.recv(65536):
            self.script += received.decode("utf-8", "replace")
            if self.script.rstrip().endswith("end"):
                self._state, self._program_running = READY, True

    def _serve_dashboard(self, link):
        link.sendall(b"Connected: Universal Robots Dashboard Server\n")
        answers = {"PolyscopeVersion": "URSoftware 3.15.8.106339 (Dec 02 2021)", "stop": "Stopped"}
        for line in link.makefile():
            answer = answers.get(line.strip(), f"could not understand: '{line.strip()}'")
            link.sendall(f"{answer}\n".encode())

    def _serve_gripper(self, link):
        for line in link.makefile():
            self.lines.append(line.strip())
            verb, *words = line.split()
            if verb == "GET":
                link.sendall(f"{words[0]} {self.gripper[words[0]]}\n".encode())
                continue
            for name, value in zip(words[::2], words[1::2], strict=True):
                if name == "POS":
                    self.gripper["PRE"] = int(value)
                elif name == "ACT":
                    self.gripper |= {"ACT": int(value), "STA": 3 * int(value)}
                elif name == "GTO" and value == "0":
                    self.gripper["PRE"] = self.gripper["POS"]
            link.sendall(b"ack")


def _send(link, kind, body):
    link.sendall(struct.pack(">HB", len(body) + 3, kind) + body)


def _exactly(link, size):
    data = b""
    while len(data) < size:
        more = link.recv(size - len(data))
        if not more:
            raise ConnectionError
        data += more
    return data


def main() -> None:
    """Be the controller until the input ends.

    ``protective_stop`` makes it refuse to move, ``power_up_gripper`` leaves the gripper inactive.
    """
    controller = UrController(sys.argv[1], np.array(json.loads(sys.argv[2])))
    print("{}", flush=True)
    for line in sys.stdin:
        controller.protective_stop |= line.strip() == "protective_stop"
        if line.strip() == "power_up_gripper":
            controller.gripper |= {"ACT": 0, "STA": 0}
        state = {
            "joints": controller.joints.tolist(),
            "commands": controller.commands,
            "lines": controller.lines,
            "script": len(controller.script),
        }
        print(json.dumps(state), flush=True)


if __name__ == "__main__":
    main()
