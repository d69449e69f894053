"""Many worlds of one model stepped together in C threads."""

from __future__ import annotations

import os

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from eisp_data.errors import DataError
from eisp_data.sim.scene import SUBSTEPS, TIMESTEP_S


def default_threads() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Physics:
    """A pure function from (states, controls) to states, one control step on.

    A state is MuJoCo's full physics state ``[time, qpos, qvel]``. Nothing is kept between calls,
    not even the solver's warm start, so any recorded state can be resumed and replays bit by bit,
    whatever the number of worlds or threads.
    """

    def __init__(self, model: mujoco.MjModel, threads: int | None = None) -> None:
        self.model = model
        self.state_dim = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        threads = default_threads() if threads is None else threads
        self._threads = threads
        self._data = [mujoco.MjData(model) for _ in range(max(1, threads))]
        self._pool = Rollout(nthread=threads if threads > 1 else 0)

    def __reduce__(self) -> tuple[type[Physics], tuple[mujoco.MjModel, int]]:
        return Physics, (self.model, self._threads)

    def step(self, state: np.ndarray, control: np.ndarray) -> np.ndarray:
        """Apply the controls of one control period in every world.

        Args:
            state: (N, P) float64.
            control: (N, SUBSTEPS, U) float64, in the units of the model's actuators.

        Returns:
            (N, P) float64, the states SUBSTEPS time steps later.

        Raises:
            DataError: a control is not finite, or the physics of a world has broken down. MuJoCo
                would go on with no control, or from the model's own first state.
        """
        worlds = len(state)
        if not np.isfinite(control).all():
            raise DataError(f"world {_first(~np.isfinite(control))}: its control is not finite")
        path = np.empty((worlds, SUBSTEPS, self.state_dim))
        sensors = np.empty((worlds, SUBSTEPS, self.model.nsensordata))
        self._pool.rollout(
            [self.model] * worlds,
            self._data,
            np.ascontiguousarray(state, dtype=np.float64),
            control,
            nstep=SUBSTEPS,
            state=path,
            sensordata=sensors,
            # Small enough that no thread waits long for the last one.
            chunk_size=max(1, worlds // (8 * len(self._data))),
            skip_checks=True,
            initial_warmstart=None,
        )
        ends = path[:, -1].copy()
        lost = np.abs(ends[:, 0] - state[:, 0] - SUBSTEPS * TIMESTEP_S) > TIMESTEP_S / 2
        if lost.any():
            raise DataError(
                f"world {_first(lost)}: its physics has broken down; is its state sound?"
            )
        return ends


def _first(where: np.ndarray) -> int:
    """Return the index along the first axis of the first True."""
    return int(np.argwhere(where)[0, 0])
