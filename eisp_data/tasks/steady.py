"""Servo targets that move at a constant speed, for tasks in which the fingers push."""

from __future__ import annotations

import numpy as np

from eisp_data.sim.scene import SUBSTEPS, TIMESTEP_S
from eisp_data.tasks.base import Task


class SteadyTask(Task):
    """A task whose gripper moves at one speed within each control period.

    A servo target that jumps makes the fingers lunge and kick a block out of reach. A target that
    leads by the servo's own lag and then moves on keeps the fingers at one speed.
    """

    def control(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Turn (N, 4) actions into (N, SUBSTEPS, 5) servo targets, one for each time step."""
        target = super().control(state, action)
        start = self.qpos(state)[:, :3]
        passed = np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS
        path = np.repeat(target[:, None], SUBSTEPS, axis=1)
        path[..., :3] = start[:, None] + (target[:, None, :3] - start[:, None]) * (
            passed + self._servo_lag
        )
        return path

    @property
    def _servo_lag(self) -> float:
        """Damping by stiffness of the gripper's servo, in control periods."""
        _, stiffness, damping = -self.model.actuator_biasprm[0, :3]
        return float(damping / stiffness / (TIMESTEP_S * SUBSTEPS))
