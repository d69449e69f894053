"""What every table-top task shares: its state, its observation, its action and its reward.

A task is stateless. All its methods are vectorised over the N worlds of a batch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from eisp_data.sim.physics import Physics
from eisp_data.sim.rotation import euler_from_quaternion, rotate
from eisp_data.sim.scene import (
    BLOCK_SIZE_M,
    FINGER_TRAVEL_M,
    SUBSTEPS,
    TIMESTEP_S,
    WORKSPACE_HIGH_M,
    WORKSPACE_LOW_M,
    compile_scene,
)
from eisp_data.tasks.paper import PaperSettings

GRIPPER_DIM = 10
"""Position 3, fingers 2, velocity 3, finger velocities 2."""
OBJECT_DIM = 15
"""Position 3, position relative to the gripper 3, orientation 3, velocity 3, angular velocity 3."""
SUCCESS_DISTANCE_M = 0.05
"""epsilon of the paper's Eq. (1), on the norm of the whole goal error."""
ACTION_SCALE_M = 0.04
"""Displacement commanded by an action of 1: 1 m/s at 25 Hz, the tool speed of a UR3."""

AT_REST_M_S = 0.02
_LOOSE_M = 0.004
"""A finger so far from a block is off it."""
_GRIPPER_JOINTS = 5


@dataclass(frozen=True)
class ObjectSlot:
    """Where one object of the goal stands in the observation and in the goal."""

    kind: str
    """Objects of one kind are interchangeable."""
    observation: slice
    """Its OBJECT_DIM features in the observation."""
    goal: slice
    """Its position in the goal."""


def compute_reward(achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
    """Return the paper's Eq. (1): 0 where the norm of the goal error is at most 5 cm, else -1.

    Args:
        achieved_goal: (..., G) metres.
        desired_goal: (..., G) metres.

    Returns:
        (...) float32.
    """
    return np.where(is_success(achieved_goal, desired_goal), 0.0, -1.0).astype(np.float32)


def is_success(achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
    """Return whether the norm of the whole (..., G) goal error is at most 5 cm, (...) bool."""
    return np.linalg.norm(achieved_goal - desired_goal, axis=-1) <= SUCCESS_DISTANCE_M


class Task(ABC):
    """A goal-conditioned task on the table.

    ``qpos`` is ``[gripper 3, fingers 2, fixtures F, blocks 7 each]``, ``qvel`` likewise with 6 a
    block; states are MuJoCo's full physics state ``[time, qpos, qvel]``.
    """

    name: ClassVar[str]
    instruction: ClassVar[str]
    """What one would tell the robot; the task string of the LeRobot dataset."""
    paper: ClassVar[PaperSettings]
    blocks: ClassVar[int]
    fixtures: ClassVar[int] = 0
    """Slide joints between the gripper's and the blocks'."""
    fingers_closed: ClassVar[bool] = False
    """Whether the fourth action has no effect."""

    @property
    @abstractmethod
    def scene(self) -> str:
        """What stands on the table, as MJCF."""

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled scene."""
        return compile_scene(self.scene)

    @abstractmethod
    def reset(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw a start state (P,) and a desired goal (G,)."""

    @property
    def objects(self) -> tuple[ObjectSlot, ...]:
        """The objects of the goal, in the order of the goal."""
        return tuple(
            ObjectSlot(
                kind="block",
                observation=slice(GRIPPER_DIM + OBJECT_DIM * i, GRIPPER_DIM + OBJECT_DIM * (i + 1)),
                goal=slice(3 * i, 3 * i + 3),
            )
            for i in range(self.blocks)
        )

    def control(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Turn (N, 4) actions in [-1, 1] into (N, SUBSTEPS, 5) servo targets.

        The first three move the gripper relative to where it is, within the workspace; the fourth
        opens (1) or closes (-1) the fingers. Within a control period the gripper's targets move at
        one speed, ahead by the servo's own lag: one that jumps would make the fingers lunge.
        """
        action = np.clip(action, -1.0, 1.0)
        start = self.qpos(state)[:, None, :3]
        target = np.clip(
            start + ACTION_SCALE_M * action[:, None, :3], WORKSPACE_LOW_M, WORKSPACE_HIGH_M
        )
        passed = np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS
        path = np.empty((len(state), SUBSTEPS, _GRIPPER_JOINTS))
        path[..., :3] = start + (target - start) * (passed + self._servo_lag)
        # Nor may it run ahead into the table.
        path[..., 2] = np.maximum(path[..., 2], WORKSPACE_LOW_M[2])
        opening = 0.0 if self.fingers_closed else (action[:, None, 3:] + 1.0) / 2.0
        path[..., 3:] = FINGER_TRAVEL_M * opening
        return path

    @property
    def _servo_lag(self) -> float:
        """Damping by stiffness of the gripper's servo, in control periods."""
        _, stiffness, damping = -self.model.actuator_biasprm[0, :3]
        return float(damping / stiffness / (TIMESTEP_S * SUBSTEPS))

    def observe(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, S) float32 observations of (N, P) states."""
        qpos, qvel = self.qpos(state), self.qvel(state)
        blocks = self._block_features(state).reshape(len(state), -1)
        parts = [qpos[:, :5], qvel[:, :5], blocks, *self.extra_features(state)]
        return np.concatenate(parts, axis=1, dtype=np.float32, casting="same_kind")

    def extra_features(self, state: np.ndarray) -> list[np.ndarray]:
        """Return what the fixtures add to the observation, each (N, ...)."""
        return []

    def achieved_goal(self, state: np.ndarray) -> np.ndarray:
        """Return phi(s), the (N, G) float32 positions of the goal's objects."""
        return self.block_positions(state).reshape(len(state), -1).astype(np.float32)

    def settled(self, state: np.ndarray) -> np.ndarray:
        """Return whether every block is at rest and no block is held, (N,) bool."""
        speeds = self._block_qvel(state)[..., :3]
        slow = (np.linalg.norm(speeds, axis=-1) < AT_REST_M_S).all(axis=1)
        return slow & self.hands_off(state)

    def hands_off(self, state: np.ndarray) -> np.ndarray:
        """Return whether no block is between the fingers, (N,) bool."""
        poses = self._block_poses(state)
        offset = np.abs(poses[..., :3] - self.qpos(state)[:, None, :3])
        near = (offset < 0.03).all(axis=-1)
        # The fingers move along y. A block that is turned reaches further along it.
        y = rotate(poses[..., 3:] * [1, -1, -1, -1], np.array([0.0, 1.0, 0.0]))
        reach = BLOCK_SIZE_M / 2 * np.abs(y).sum(axis=-1)
        squeezed = self.qpos(state)[:, 3:5].mean(axis=1, keepdims=True) < reach + _LOOSE_M
        return ~(near & squeezed).any(axis=1)

    def block_positions(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, blocks, 3) positions of the blocks' centres."""
        return self._block_poses(state)[..., :3]

    def qpos(self, state: np.ndarray) -> np.ndarray:
        """Return the view (..., nq) of the joint positions."""
        return state[..., 1 : 1 + self.model.nq]

    def qvel(self, state: np.ndarray) -> np.ndarray:
        """Return the view (..., nv) of the joint velocities."""
        return state[..., 1 + self.model.nq :]

    def state_of(
        self, gripper: np.ndarray, blocks: np.ndarray, fixtures: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the state (P,) at rest with open fingers and upright blocks.

        Args:
            gripper: (3,) position between the fingertips.
            blocks: (blocks, 3) positions.
            fixtures: (F,) positions of the fixtures' slides, zero if left out.
        """
        state = np.zeros(1 + self.model.nq + self.model.nv)
        qpos = self.qpos(state)
        qpos[:3] = gripper
        qpos[3:5] = 0.0 if self.fingers_closed else FINGER_TRAVEL_M
        start = _GRIPPER_JOINTS + self.fixtures
        if fixtures is not None:
            qpos[_GRIPPER_JOINTS:start] = fixtures
        poses = qpos[start:].reshape(self.blocks, 7)
        poses[:, :3] = blocks
        poses[:, 3] = 1.0
        return state

    def physics(self, threads: int | None = None) -> Physics:
        """Return the batched physics of this task's scene."""
        return Physics(self.model, threads)

    def _block_poses(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, blocks, 7) positions and quaternions of the blocks."""
        start = _GRIPPER_JOINTS + self.fixtures
        return self.qpos(state)[:, start:].reshape(len(state), self.blocks, 7)

    def _block_qvel(self, state: np.ndarray) -> np.ndarray:
        start = _GRIPPER_JOINTS + self.fixtures
        return self.qvel(state)[:, start:].reshape(len(state), self.blocks, 6)

    def _block_features(self, state: np.ndarray) -> np.ndarray:
        """Return the (N, blocks, OBJECT_DIM) features of the blocks."""
        poses = self._block_poses(state)
        velocities = self._block_qvel(state)
        position, quaternion = poses[..., :3], poses[..., 3:]
        features = np.empty((len(state), self.blocks, OBJECT_DIM), np.float32)
        features[..., :3] = position
        features[..., 3:6] = position - self.qpos(state)[:, None, :3]
        features[..., 6:9] = euler_from_quaternion(quaternion)
        features[..., 9:12] = velocities[..., :3]
        # MuJoCo's free joint keeps the angular velocity in the frame of the body.
        features[..., 12:] = rotate(quaternion, velocities[..., 3:])
        return features
