"""How fast the worlds step, against Gymnasium-Robotics and against MuJoCo itself, in one run.

    python benchmarks/sim.py                  # prints a table of rates and their ratios

Stack, three blocks, 64 worlds, resets and observations included, against
- FetchPickAndPlace (one block) in Gymnasium's AsyncVectorEnv, resets and observations included;
- ``mujoco.rollout`` on the same model, worlds, threads and controls, which observes nothing.

All take random actions, in short turns one after the other, so that whatever else the machine does
meets all three alike; the rates are over the sums of the turns.
"""

from __future__ import annotations

import dataclasses
import time

import mujoco
import numpy as np
import tyro
from mujoco.rollout import Rollout

from eisp_data.sim.physics import default_threads
from eisp_data.sim.scene import SUBSTEPS
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import Task
from eisp_data.tasks.registry import get_task


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    task: str = "stack"
    worlds: int = 64
    threads: int = dataclasses.field(default_factory=default_threads)
    peer_envs: int = 8
    """Processes of the AsyncVectorEnv."""
    turns: int = 24
    """Turns of each; 12 are an episode of Stack."""
    turn_steps: int = 25
    """Control steps of one turn in each of our worlds."""


class Ours:
    """The worlds of a task, reset at the end of each episode."""

    def __init__(self, task: Task, options: Options) -> None:
        self._worlds = Worlds(task, options.worlds, options.threads)
        self._steps = options.turn_steps
        self._rng = np.random.default_rng(0)
        self._episode = 0
        self._reset(np.arange(options.worlds))

    def _reset(self, worlds: np.ndarray) -> None:
        self._worlds.reset(worlds + self._episode * self._worlds.count, worlds)
        self._episode += 1

    def turn(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Return seconds, the states (N, P) at the start and the controls (N, steps, U)."""
        worlds, first, controls = self._worlds, self._worlds.state.copy(), []
        begin = time.perf_counter()
        for _ in range(self._steps):
            action = self._rng.uniform(-1, 1, (worlds.count, 4))
            controls.append((worlds.state, action))
            worlds.step(action)
            _ = worlds.observation, worlds.achieved_goal, worlds.success
        over = np.flatnonzero(worlds.truncated)
        if len(over):
            self._reset(over)
        seconds = time.perf_counter() - begin
        path = [worlds.task.control(state, action) for state, action in controls]
        held = [np.repeat(c[:, None], SUBSTEPS, axis=1) if c.ndim == 2 else c for c in path]
        return seconds, first, np.concatenate(held, axis=1)


class Raw:
    """One call of MuJoCo's own rollout for all the steps of a turn."""

    def __init__(self, task: Task, options: Options) -> None:
        self._models = [task.model] * options.worlds
        self._data = [mujoco.MjData(task.model) for _ in range(options.threads)]
        self._pool = Rollout(nthread=options.threads if options.threads > 1 else 0)

    def turn(self, first: np.ndarray, control: np.ndarray) -> float:
        """Return seconds."""
        begin = time.perf_counter()
        self._pool.rollout(self._models, self._data, first, control)
        return time.perf_counter() - begin


class Peer:
    """FetchPickAndPlace in a process each."""

    def __init__(self, options: Options) -> None:
        import gymnasium
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        self._envs = gymnasium.make_vec(
            "FetchPickAndPlace-v4", options.peer_envs, vectorization_mode="async"
        )
        self._envs.reset(seed=0)
        self._envs.action_space.seed(0)
        self._turn_steps = 10
        self.turn()

    def turn(self) -> tuple[float, int]:
        """Return seconds and env-steps; an episode, with its resets, is five turns."""
        begin = time.perf_counter()
        for _ in range(self._turn_steps):
            self._envs.step(self._envs.action_space.sample())
        return time.perf_counter() - begin, self._turn_steps * self._envs.num_envs

    def close(self) -> None:
        """End its processes."""
        self._envs.close()


def main(options: Options) -> None:
    """Measure and print the table."""
    task = get_task(options.task)
    ours, raw, peer = Ours(task, options), Raw(task, options), Peer(options)
    seconds = np.zeros(3)
    steps = np.zeros(3)
    for _ in range(options.turns):
        our_seconds, first, control = ours.turn()
        peer_seconds, peer_steps = peer.turn()
        seconds += our_seconds, raw.turn(first, control), peer_seconds
        our_steps = options.worlds * options.turn_steps
        steps += our_steps, our_steps, peer_steps
    peer.close()
    rates = steps / seconds
    print(
        f"{options.worlds} worlds of {task.name} in {options.threads} threads; "
        f"{options.peer_envs} processes of the peer; {options.turns} turns each"
    )
    print(f"{'':44}{'env-steps/s':>12}{'ours is':>10}")
    names = (
        f"{task.name}, resets and observations",
        "mujoco.rollout, same controls, physics only",
        "FetchPickAndPlace-v4, AsyncVectorEnv",
    )
    for name, rate in zip(names, rates, strict=True):
        print(f"{name:44}{rate:12,.0f}{rates[0] / rate:9.2f}x")


if __name__ == "__main__":
    main(tyro.cli(Options))
