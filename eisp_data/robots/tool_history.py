"""Where the gripper was at any time of the last second: images show the past."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from eisp_data.robots.kinematics import Kinematics
from eisp_data.robots.robot import Reading

_KEPT = 200


@dataclass(frozen=True)
class ToolState:
    """The gripper at one time, in the task's frame."""

    time_s: float
    transform_tool_to_task: np.ndarray
    """(4, 4)."""
    velocity: np.ndarray
    """(3,) m/s."""
    spin: np.ndarray
    """(3,) rad/s."""
    opening_m: float
    opening_speed_m_s: float


class ToolHistory:
    """Tool states from joint readings."""

    def __init__(self, kinematics: Kinematics, transform_base_to_task: np.ndarray) -> None:
        self._kinematics, self._to_task = kinematics, transform_base_to_task
        self._states: deque[ToolState] = deque(maxlen=_KEPT)

    def __len__(self) -> int:
        return len(self._states)

    @property
    def newest(self) -> ToolState:
        """The state of the last reading."""
        return self._states[-1]

    def add(self, reading: Reading) -> ToolState:
        """Note a reading; one that is no newer than the last is ignored."""
        if self._states and reading.hardware_s <= self.newest.time_s:
            return self.newest
        speed = 0.0
        if self._states:
            passed = reading.hardware_s - self.newest.time_s
            speed = (reading.gripper_opening_m - self.newest.opening_m) / passed
        moving = self._kinematics.jacobian(reading.joint_position) @ reading.joint_velocity
        rotation = self._to_task[:3, :3]
        state = ToolState(
            time_s=reading.hardware_s,
            transform_tool_to_task=self._to_task @ self._kinematics.forward(reading.joint_position),
            velocity=rotation @ moving[:3],
            spin=rotation @ moving[3:],
            opening_m=reading.gripper_opening_m,
            opening_speed_m_s=speed,
        )
        self._states.append(state)
        return state

    def at(self, time_s: float) -> np.ndarray:
        """Return the tool's (4, 4) pose to the task then; the ends stand for what is beyond."""
        after = next((s for s in reversed(self._states) if s.time_s <= time_s), None)
        if after is None:
            return self._states[0].transform_tool_to_task
        index = self._states.index(after)
        if index + 1 == len(self._states):
            return after.transform_tool_to_task
        later = self._states[index + 1]
        share = (time_s - after.time_s) / (later.time_s - after.time_s)
        return state_between(after, later, share).transform_tool_to_task

    def since(self, time_s: float) -> list[ToolState]:
        """Return the states after that time, oldest first."""
        return [state for state in self._states if state.time_s > time_s]


def state_between(before: ToolState, after: ToolState, share: float) -> ToolState:
    """Return the tool's state at a share of the time between two; its rotation is the nearer's."""

    def mix(first: Any, last: Any) -> Any:
        return (1 - share) * first + share * last

    pose = (after if share > 0.5 else before).transform_tool_to_task.copy()
    pose[:3, 3] = mix(before.transform_tool_to_task[:3, 3], after.transform_tool_to_task[:3, 3])
    return ToolState(
        time_s=mix(before.time_s, after.time_s),
        transform_tool_to_task=pose,
        velocity=mix(before.velocity, after.velocity),
        spin=mix(before.spin, after.spin),
        opening_m=mix(before.opening_m, after.opening_m),
        opening_speed_m_s=after.opening_speed_m_s,
    )
