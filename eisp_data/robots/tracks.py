"""What is believed about each object from one image to the next, and while none shows it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from eisp_data.robots.contact import drag_drawer, push_out
from eisp_data.robots.fall import Fall
from eisp_data.robots.grip import Grip, grip_of
from eisp_data.robots.pose import PoseFit
from eisp_data.robots.tool_history import ToolState
from eisp_data.sim.scene import BLOCK_SIZE_M

HALF_M = BLOCK_SIZE_M / 2

_STILL_M, _STILL_RAD = 0.0015, 0.02
"""What moved less from one image to the next stands still: that much is noise."""
_SMOOTHING = 0.3
"""Weight of a new image of what stands still."""
_SLACK_M, _SLACK_M_S, _MOST_SLACK_M = 0.035, 0.8, 0.15
"""How far from where it was believed to be an object may turn up at once; further off, another
image has to say the same."""
_AGREE_M = 0.012
_LOST_GRIP_M = 0.025
_CONTRADICTIONS = 2
_PAST = 200


class BlockTrack:
    """One block.

    Attributes:
        pose: (4, 4) object to task at the last tool state, None before it was first seen.
        velocity, spin: (3,) m/s and rad/s, in the task's frame.
        seen_s: when the last image that shows it was captured.
        held: whether the fingers hold it.
    """

    def __init__(self) -> None:
        self.pose: np.ndarray | None = None
        self.velocity: np.ndarray = np.zeros(3)
        self.spin: np.ndarray = np.zeros(3)
        self.seen_s = -np.inf
        self._grip: Grip | None = None
        self._fall: Fall | None = None
        self._free_since_s = -np.inf
        self._seen: np.ndarray | None = None
        self._elsewhere: np.ndarray | None = None
        self._contradictions = 0

    @property
    def held(self) -> bool:
        """Whether the fingers hold it."""
        return self._grip is not None

    def expected(self, time_s: float, tool_then: np.ndarray) -> np.ndarray | None:
        """Return its (4, 4) pose at a time when the tool was at (4, 4)."""
        return self.pose if self._grip is None else self._grip.block_then(time_s, tool_then)

    def see(
        self, fit: PoseFit, captured_s: float, tool_then: np.ndarray, tools: list[ToolState]
    ) -> None:
        """Take in what an image shows.

        Args:
            fit: its pose then.
            captured_s: when.
            tool_then: (4, 4), the tool's pose then.
            tools: the tool's states since.
        """
        if captured_s < self._free_since_s:
            return  # It was in the fingers then, or in the air.
        pose = fit.transform_object_to_task
        believed = self.expected(captured_s, tool_then)
        if believed is not None and self._is_elsewhere(pose, believed, captured_s):
            return
        passed = captured_s - self.seen_s
        self.seen_s = captured_s
        if self._grip is not None:
            self._grip.refine(pose, fit.covariance, captured_s, tool_then)
            return
        self._measure_motion(pose, passed)
        still = not self.velocity.any()
        if still and believed is not None and self._seen is not None:
            pose = pose.copy()
            step = pose[:3, 3] - believed[:3, 3]
            if np.linalg.norm(step) < 2 * _STILL_M:
                pose[:3, 3] = believed[:3, 3] + _SMOOTHING * step
        self._seen = fit.transform_object_to_task
        self.pose = pose
        before = tool_then
        for tool in tools:
            self._push(before, tool)
            before = tool.transform_tool_to_task

    def follow(
        self, before: ToolState, tool: ToolState, standing_m: Callable[[np.ndarray], float]
    ) -> None:
        """Go on to the tool's newest state: held, pushed, let go of or left alone.

        Args:
            before: the state before.
            tool: the newest state.
            standing_m: returns the height at which the block would stand if it is let go of at a
                pose (4, 4), or does if it is no higher.
        """
        if self.pose is None:
            return
        if self._grip is None:
            self._go_on_alone(before, tool)
        else:
            moment = self._grip.released(before, tool)
            if moment is not None:
                self._let_go(self._grip, moment, standing_m)
        if self._grip is not None:
            self.pose = tool.transform_tool_to_task @ self._grip.transform_block_to_tool
            sunk_m = standing_m(self.pose) - self.pose[2, 3]
            if sunk_m > 0.0:
                # Fingers that go on down slide along a block that stands.
                self._grip.slip(sunk_m, tool.transform_tool_to_task)
                self.pose[2, 3] += sunk_m
            self.velocity, self.spin = _velocity_at(self.pose, tool), tool.spin

    def _go_on_alone(self, before: ToolState, tool: ToolState) -> None:
        assert self.pose is not None
        if self._fall is not None:
            self.pose = self._fall.pose(tool.time_s)
            if tool.time_s < self._fall.landed_s:
                return
            self._fall = None
        self._push(before.transform_tool_to_task, tool)
        if tool.time_s - self.seen_s > 0.1:
            self.velocity, self.spin = np.zeros(3), np.zeros(3)
        self._grip = grip_of(self.pose, before, tool)

    def shift(self, way: np.ndarray) -> None:
        """Move with what it lies in, by (3,) m."""
        if self.pose is not None and not self.held:
            self.pose = self.pose.copy()
            self.pose[:3, 3] += way

    def _is_elsewhere(self, pose: np.ndarray, believed: np.ndarray, captured_s: float) -> bool:
        """Return whether to wait for another image before believing this one."""
        slack = min(_SLACK_M + _SLACK_M_S * (captured_s - self.seen_s), _MOST_SLACK_M)
        if self.held:
            slack = _LOST_GRIP_M
        if np.linalg.norm(pose[:3, 3] - believed[:3, 3]) <= slack:
            self._elsewhere, self._contradictions = None, 0
            return False
        if self._elsewhere is not None:
            same = np.linalg.norm(pose[:3, 3] - self._elsewhere[:3, 3]) <= _AGREE_M
            self._contradictions = self._contradictions + 1 if same or self.held else 1
        else:
            self._contradictions = 1
        self._elsewhere = pose
        if self._contradictions < _CONTRADICTIONS:
            return True
        self._elsewhere, self._contradictions, self._grip, self._seen = None, 0, None, None
        return False

    def _measure_motion(self, pose: np.ndarray, passed_s: float) -> None:
        """Set the velocities from this pose and the one seen before."""
        self.velocity, self.spin = np.zeros(3), np.zeros(3)
        if self._seen is None or not 0 < passed_s < 0.2:
            return
        way = pose[:3, 3] - self._seen[:3, 3]
        if np.linalg.norm(way) > _STILL_M:
            self.velocity = way / passed_s
        turn = pose[:3, :3] @ self._seen[:3, :3].T
        vector = np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        if np.linalg.norm(vector) > 2 * _STILL_RAD:
            self.spin = vector / 2 / passed_s

    def _push(self, tool_before: np.ndarray, tool: ToolState) -> None:
        assert self.pose is not None
        here = tool.transform_tool_to_task
        way = here[:3, 3] - tool_before[:3, 3]
        self.pose = push_out(self.pose, here, tool.opening_m, way)

    def _let_go(
        self, grip: Grip, moment: ToolState, standing_m: Callable[[np.ndarray], float]
    ) -> None:
        """Let it fall on what is below it, with the speed that it has."""
        pose = moment.transform_tool_to_task @ grip.transform_block_to_tool
        self._fall = Fall(pose, _velocity_at(pose, moment), moment.time_s, standing_m(pose))
        self._free_since_s = self._fall.landed_s
        self._grip = self._seen = None
        self.velocity, self.spin = np.zeros(3), np.zeros(3)
        self.pose = pose


class DrawerTrack:
    """The drawer.

    Attributes:
        opening_m: at the last tool state, None before it was first seen.
        speed_m_s: at which it opens.
        seen_s: when the last image that shows it was captured.
    """

    def __init__(self) -> None:
        self.opening_m: float | None = None
        self.speed_m_s = 0.0
        self.seen_s = -np.inf
        self._seen_m: float | None = None
        self._past: deque[tuple[float, float]] = deque(maxlen=_PAST)

    def at(self, time_s: float) -> float:
        """Return how far it was open at a time of the last second, metres, as is believed now."""
        times, openings = zip(*self._past, strict=True)
        return float(np.interp(time_s, times, openings))

    def see(
        self, opening_m: float, captured_s: float, tool_then: np.ndarray, tools: list[ToolState]
    ) -> None:
        """Take in what an image shows; the rest as in ``BlockTrack.see``."""
        passed = captured_s - self.seen_s
        self.speed_m_s = 0.0
        if self._seen_m is not None and 0 < passed < 0.2:
            way = opening_m - self._seen_m
            self.speed_m_s = way / passed if abs(way) > _STILL_M / 3 else 0.0
        self.seen_s, self._seen_m = captured_s, opening_m
        while self._past and self._past[-1][0] >= captured_s:
            self._past.pop()
        self.opening_m = opening_m
        self._past.append((captured_s, opening_m))
        for tool in tools:
            self.follow(tool_then, tool)
            tool_then = tool.transform_tool_to_task

    def follow(self, before: np.ndarray, tool: ToolState) -> None:
        """Go on to the tool's newest state from when it was at (4, 4)."""
        if self.opening_m is not None:
            self.opening_m = drag_drawer(self.opening_m, before, tool.transform_tool_to_task)
            self._past.append((tool.time_s, self.opening_m))


def _velocity_at(pose: np.ndarray, tool: ToolState) -> np.ndarray:
    """Return the velocity (3,) m/s of what the tool holds at a pose (4, 4)."""
    arm = pose[:3, 3] - tool.transform_tool_to_task[:3, 3]
    return tool.velocity + np.cross(tool.spin, arm)
