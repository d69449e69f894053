"""Scripted demonstrations: one script in each of many worlds, one Episode for each seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict

import numpy as np

from eisp_data.episode import Episode
from eisp_data.policies.script import Noise, Script, ScriptedPolicy
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import Task, compute_reward, is_success

_TAIL_STEPS = 5
"""An episode goes on this long after its script has ended, for what is falling to come to rest."""


def collect(
    task: Task,
    script: Script,
    noise: Noise,
    seeds: Sequence[int],
    *,
    worlds: int = 64,
    threads: int | None = None,
) -> Iterator[Episode]:
    """Yield one Episode for each seed, in the order of the seeds.

    An episode depends on its seed alone, not on how many worlds run beside it or how many threads.
    """
    worlds = min(worlds, len(seeds))
    batch = Worlds(task, worlds, threads)
    policy = ScriptedPolicy(task, script, noise, worlds)
    recorders: list[_Recorder | None] = [None] * worlds
    finished: dict[int, Episode] = {}
    started = yielded = 0
    while yielded < len(seeds):
        for world, recorder in enumerate(recorders):
            if recorder is None and started < len(seeds):
                seed = seeds[started]
                batch.reset([seed], np.array([world]))
                goal = batch.desired_goal[world].copy()
                policy.begin(world, batch.state, goal, seed)
                recorders[world] = _Recorder(started, seed, goal, batch.state[world])
                started += 1
        action = policy.act(batch.state)
        batch.step(action)
        over = policy.finished
        for world, recorder in enumerate(recorders):
            if recorder is None:
                continue
            recorder.add(action[world], batch.state[world], bool(over[world]))
            if recorder.complete(bool(batch.truncated[world])):
                finished[recorder.order] = recorder.episode(task, noise)
                recorders[world] = None
        while yielded in finished:
            yield finished.pop(yielded)
            yielded += 1


class _Recorder:
    """The states and actions of one episode in progress."""

    def __init__(self, order: int, seed: int, goal: np.ndarray, state: np.ndarray) -> None:
        self.order, self.seed, self.goal = order, seed, goal
        self.states, self.actions = [state.copy()], []
        self._tail = 0

    def add(self, action: np.ndarray, state: np.ndarray, over: bool) -> None:
        self.actions.append(action)
        self.states.append(state.copy())
        self._tail += over

    def complete(self, truncated: bool) -> bool:
        return truncated or self._tail >= _TAIL_STEPS

    def episode(self, task: Task, noise: Noise) -> Episode:
        states = np.stack(self.states)
        achieved = task.achieved_goal(states)
        steps = len(self.actions)
        truncated = np.zeros(steps, bool)
        truncated[-1] = True
        return Episode(
            observation=task.observe(states),
            achieved_goal=achieved,
            desired_goal=self.goal,
            action=np.stack(self.actions).astype(np.float32),
            reward=compute_reward(achieved[1:], self.goal),
            done=np.zeros(steps, bool),
            truncated=truncated,
            success=is_success(achieved, self.goal),
            sim_state=states,
            seed=self.seed,
            info={"task": task.name, "policy": "scripted", **asdict(noise)},
        )
