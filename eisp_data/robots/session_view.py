"""What is known at one tick, laid out as policies and scripts know it from simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from eisp_data.robots.calibration import Calibration
from eisp_data.robots.estimates import Estimates, state_from_estimates
from eisp_data.robots.kinematics import kinematics
from eisp_data.robots.robot import CameraFrame, Reading
from eisp_data.robots.tool_history import ToolHistory
from eisp_data.robots.tracker import Tracker
from eisp_data.tasks.base import Task


@dataclass(frozen=True)
class Seen:
    """What is known at one tick."""

    at_s: float
    """On the robot's clock."""
    state: np.ndarray
    """(P,) MuJoCo's full physics state of the task's scene, as far as it can be perceived; empty
    without a task."""
    observation: np.ndarray
    """(S,) float32; without a task the gripper's part of it."""
    achieved_goal: np.ndarray
    """(G,) float32; without a task where the gripper is."""
    settled: bool
    """All is at rest and let go of."""
    estimates: Estimates

    @property
    def gripper_m(self) -> np.ndarray:
        """(3,) the point between the fingertips, in the task's frame."""
        return self.estimates.tool.transform_tool_to_task[:3, 3]

    @property
    def age_s(self) -> float:
        """Since the object that has been out of sight longest was last seen."""
        return max((thing.age_s for thing in self.estimates.objects.values()), default=0.0)


class Eyes(Protocol):
    """From readings and images to what is known."""

    def look(self, frames: dict[str, CameraFrame], reading: Reading) -> None:
        """Take in the newest images; RobotError where they cannot be of this cell."""

    def missing(self) -> list[str]:
        """Return what has not been seen yet."""

    def see(self, at_s: float, reading: Reading) -> Seen:
        """Return what is known, once nothing is missing."""


class TaskEyes:
    """Keeps track of a task's objects by their markers."""

    def __init__(self, task: Task, calibration: Calibration, camera: str, arm: str) -> None:
        self._task, self._camera = task, camera
        self._tracker = Tracker(task, calibration, camera, arm)

    def look(self, frames: dict[str, CameraFrame], reading: Reading) -> None:
        """Take in the newest image; RobotError where it cannot be of this cell."""
        self._tracker.update(reading, frames.get(self._camera))
        self._tracker.check()

    def missing(self) -> list[str]:
        """Return what has not been seen yet."""
        return self._tracker.missing()

    def see(self, at_s: float, reading: Reading) -> Seen:
        """Return what is known, once nothing is missing."""
        return seen(self._task, at_s, self._tracker.update(reading))


class HandEyes:
    """Knows the gripper only: for a robot without cameras, or a table without a task."""

    def __init__(self, calibration: Calibration, arm: str) -> None:
        self._tools = ToolHistory(kinematics(arm), calibration.transform_base_to_task)

    def look(self, frames: dict[str, CameraFrame], reading: Reading) -> None:
        """Leave the images to those who look at the recording."""

    def missing(self) -> list[str]:
        """Return nothing: nothing is looked for."""
        return []

    def see(self, at_s: float, reading: Reading) -> Seen:
        """Return where the gripper is."""
        tool = self._tools.add(reading)
        position = tool.transform_tool_to_task[:3, 3]
        fingers = np.full(2, tool.opening_m / 2), np.full(2, tool.opening_speed_m_s / 2)
        observation = np.concatenate([position, fingers[0], tool.velocity, fingers[1]])
        return Seen(
            at_s=at_s,
            state=np.empty(0),
            observation=observation.astype(np.float32),
            achieved_goal=position.astype(np.float32),
            settled=False,
            estimates=Estimates(tool, {}),
        )


def seen(task: Task, at_s: float, estimates: Estimates) -> Seen:
    """Return estimates as the task's simulator would have them."""
    state = state_from_estimates(task, estimates)
    state[0] = at_s
    return Seen(
        at_s=at_s,
        state=state,
        observation=task.observe(state[None])[0],
        achieved_goal=task.achieved_goal(state[None])[0],
        settled=bool(task.settled(state[None])[0]),
        estimates=estimates,
    )
