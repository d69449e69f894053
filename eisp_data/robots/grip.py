"""When the fingers hold a block, and where in them it is.

An arm that is in a hurry leaves while its fingers still move: at 0.4 m/s a hold that is believed
to begin or to end 40 ms off takes a block 16 mm along, or leaves it behind. So both ends are looked
for in the joints' readings, at their rate, and between two of them.
"""

from __future__ import annotations

import numpy as np

from eisp_data.robots.cell import inverse
from eisp_data.robots.tool_history import ToolState, state_between
from eisp_data.sim.scene import BLOCK_SIZE_M

_LOW_M, _HIGH_M = 0.040, 0.052
"""Openings at which fingers may hold a block."""
_STOPPED_M_S = 0.0125
"""Fingers that are slower than this when they are that far apart stand against something."""
_AT_REST_M_S = 0.003
_OPENED_M = 0.0007
"""Fingers this much further apart than they were at rest have let go."""
_BETWEEN_M = np.array([0.030, 0.020, 0.032])
"""How far off the middle of the fingers a held block may be."""
_STD_M, _SLIP_STD_M = 0.002, 0.0003
"""How well it is known where the fingers have grasped a block, and what it slips by from one image
to the next."""


class Grip:
    """One hold of one block.

    Attributes:
        transform_block_to_tool: (4, 4).
    """

    def __init__(self, begun: ToolState, transform_block_to_tool: np.ndarray) -> None:
        """Begin; see ``grip_of`` for whether to."""
        self.transform_block_to_tool = transform_block_to_tool
        self._begun = begun
        self._variance: np.ndarray = _STD_M**2 * np.eye(3)
        self._rest_m: float | None = None

    def block_then(self, time_s: float, tool_then: np.ndarray) -> np.ndarray:
        """Return the block's (4, 4) pose to the task at a time when the tool was at (4, 4).

        Before it was held the block was where it was taken.
        """
        return self._tool(time_s, tool_then) @ self.transform_block_to_tool

    def released(self, before: ToolState, tool: ToolState) -> ToolState | None:
        """Return when the tool let go between two readings, None if it did not."""
        if tool.opening_m < _LOW_M:
            return tool
        most = _HIGH_M if self._rest_m is None else min(_HIGH_M, self._rest_m + _OPENED_M)
        if tool.opening_m > most:
            share = (most - before.opening_m) / max(tool.opening_m - before.opening_m, 1e-9)
            return state_between(before, tool, float(np.clip(share, 0.0, 1.0)))
        if abs(tool.opening_speed_m_s) < _AT_REST_M_S:
            # The narrowest: a load, too, moves fingers apart.
            self._rest_m = min(tool.opening_m, self._rest_m or _HIGH_M)
        return None

    def refine(
        self, pose: np.ndarray, covariance: np.ndarray, time_s: float, tool_then: np.ndarray
    ) -> None:
        """Take in where an image shows the block: a Kalman filter of what stays, but slips.

        Args:
            pose: (4, 4), to the task.
            covariance: (3, 3) m^2, of its position.
            time_s: when the image was taken.
            tool_then: (4, 4), the tool's pose then.
        """
        tool = self._tool(time_s, tool_then)
        measured = (inverse(tool) @ pose)[:3, 3]
        noise = tool[:3, :3].T @ covariance @ tool[:3, :3]
        before = self._variance + _SLIP_STD_M**2 * np.eye(3)
        gain = before @ np.linalg.inv(before + noise)
        refined = self.transform_block_to_tool.copy()
        refined[:3, 3] += gain @ (measured - refined[:3, 3])
        refined[1, 3] = 0.0
        self.transform_block_to_tool, self._variance = refined, (np.eye(3) - gain) @ before

    def slip(self, up_m: float, tool: np.ndarray) -> None:
        """Note that something from below has shifted it by so much in the fingers of a (4, 4) tool.

        By how much exactly, images have to tell.
        """
        shift = up_m * tool[2, :3]
        shifted = self.transform_block_to_tool.copy()
        shifted[:3, 3] += shift
        self.transform_block_to_tool = shifted
        self._variance = self._variance + np.diag(shift**2)

    def _tool(self, time_s: float, tool_then: np.ndarray) -> np.ndarray:
        """Return where the tool was, or where it was to be once it held the block."""
        begun = self._begun
        return begun.transform_tool_to_task if time_s < begun.time_s else tool_then


def grip_of(block: np.ndarray, before: ToolState, tool: ToolState) -> Grip | None:
    """Return the hold of a block that began between two readings, None if none did.

    Args:
        block: (4, 4) to the task.
        before: the reading before.
        tool: the newest.
    """
    closed = before.opening_m > BLOCK_SIZE_M >= tool.opening_m > _LOW_M
    stands = _LOW_M < tool.opening_m < _HIGH_M and abs(tool.opening_speed_m_s) < _STOPPED_M_S
    if not closed and not stands:
        return None
    begun = tool
    if closed:
        share = (before.opening_m - BLOCK_SIZE_M) / (before.opening_m - tool.opening_m)
        begun = state_between(before, tool, share)
    held = inverse(begun.transform_tool_to_task) @ block
    if (np.abs(held[:3, 3]) >= _BETWEEN_M).any():
        return None
    # The fingers meet in the middle.
    held[1, 3] = 0.0
    return Grip(begun, held)
