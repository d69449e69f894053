"""From columns of numbers at a fixed rate to an Episode."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from eisp_data.episode import Episode, Scalar
from eisp_data.errors import DataError
from eisp_data.storage.mcap.mapping import StreamMap

STATE, WORLD = "observation.state", "observation.environment_state"
REACHED, GOAL = "observation.achieved_goal", "observation.desired_goal"


def scale_action(stream: StreamMap, values: np.ndarray) -> np.ndarray:
    """Map [low, high] onto [-1, 1]; raises DataError where a command lies outside.

    A command is what was really sent, so it is never clipped in silence.
    """
    if stream.low:
        if len(stream.low) != values.shape[1]:
            raise DataError(
                f"{stream.topic}: {values.shape[1]} components but {len(stream.low)} limits"
            )
        low, high = np.array(stream.low), np.array(stream.high)
        values = 2 * (values - low) / (high - low) - 1
    row, component = np.unravel_index(np.argmax(np.abs(values)), values.shape)
    if abs(values[row, component]) > 1 + 1e-6:
        limits = "widen" if stream.low else "give"
        raise DataError(
            f"{stream.topic}: action component {component} is {values[row, component]:.4g}, "
            f"outside [-1, 1]; {limits} low and high in the mapping"
        )
    return np.clip(values, -1.0, 1.0)


def build_episode(
    columns: Mapping[str, np.ndarray],
    images: Mapping[str, np.ndarray],
    info: Mapping[str, Scalar],
    epsilon_m: float,
    ended: bool,
) -> Episode:
    """Build an Episode of T actions.

    Args:
        columns: role to (T + 1, D) float64; the last row of the action is not used. Without a
            desired goal the goal last achieved takes its place, as in hindsight.
        images: camera to (T + 1, H, W, 3) uint8.
        info: what is said of the episode as a whole.
        epsilon_m: norm of the goal error up to which the goal is met (the paper's Eq. 1).
        ended: the task itself ended at the last row; otherwise the episode was cut off there.

    Raises:
        DataError: achieved and desired goal are of different sizes.
    """
    state = columns[STATE]
    achieved = columns[REACHED].astype(np.float32)
    goal = columns[GOAL][0].astype(np.float32) if GOAL in columns else achieved[-1].copy()
    if goal.shape != achieved.shape[1:]:
        raise DataError(
            f"the achieved goal has {achieved.shape[1]} components, the desired goal {len(goal)}: "
            f"in the mapping, the streams to {REACHED} must be of what those to {GOAL} are of"
        )
    steps = len(state) - 1
    met = np.linalg.norm(achieved - goal, axis=1) <= epsilon_m
    done, truncated = np.zeros(steps, bool), np.zeros(steps, bool)
    done[-1], truncated[-1] = ended, not ended
    observation = np.concatenate([state, columns.get(WORLD, state[:, :0])], axis=1)
    return Episode(
        observation=observation.astype(np.float32),
        achieved_goal=achieved,
        desired_goal=goal,
        action=columns["action"][:-1].astype(np.float32),
        reward=np.where(met[1:], 0.0, -1.0).astype(np.float32),
        done=done,
        truncated=truncated,
        success=met,
        sim_state=np.zeros((steps + 1, 0)),
        seed=-1,
        info=dict(info),
        images=dict(images),
    )
