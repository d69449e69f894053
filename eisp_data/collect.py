"""Episodes by the thousand: one policy in each of many worlds, one Episode for each seed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Protocol

import numpy as np

from eisp_data.episode import Episode, Scalar
from eisp_data.policies.script import Noise, Script, ScriptedPolicy
from eisp_data.sim.gym_worlds import AnyWorlds, GymWorlds
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.base import Task, is_success

_TAIL_STEPS = 25
"""An episode goes on this long after its script has ended: what is falling comes to rest, and the
data show what to do when all is done."""


class Actor(Protocol):
    """What acts in a batch of worlds while they are recorded."""

    def begin(self, world: int, seed: int) -> None:
        """Start anew in one world, which has just been reset with this seed."""

    def act(self) -> np.ndarray:
        """Return (N, A) actions in [-1, 1] for the worlds as they are now."""

    @property
    def finished(self) -> np.ndarray:
        """(N,) bool: there is nothing left to do."""


def collect(
    task: Task,
    script: Script,
    noise: Noise,
    seeds: Sequence[int],
    *,
    worlds: int = 64,
    threads: int | None = None,
) -> Iterator[Episode]:
    """Yield one scripted Episode for each seed, in the order of the seeds.

    An episode depends on its seed alone, not on how many worlds run beside it or how many threads.
    """
    batch = Worlds(task, min(worlds, len(seeds)), threads)
    actor = _ScriptActor(batch, ScriptedPolicy(task, script, noise, batch.count))
    return record(batch, actor, seeds, {"policy": "scripted", **asdict(noise)})


def explore(worlds: AnyWorlds, seeds: Sequence[int]) -> Iterator[Episode]:
    """Yield one Episode of random actions for each seed, in the order of the seeds."""
    return record(worlds, _RandomActor(worlds), seeds, {"policy": "random"})


def record(
    worlds: AnyWorlds, actor: Actor, seeds: Sequence[int], info: Mapping[str, Scalar]
) -> Iterator[Episode]:
    """Yield what the actor does, one Episode for each seed, in the order of the seeds.

    Args:
        worlds: a batch; its worlds take the next seed as soon as they are done with one.
        actor: acts in them.
        seeds: of the resets.
        info: what is said of each episode besides the task.
    """
    recorders: list[_Recorder | None] = [None] * worlds.count
    finished: dict[int, Episode] = {}
    started = yielded = 0
    while yielded < len(seeds):
        for world in range(worlds.count):
            if recorders[world] is None and started < len(seeds):
                worlds.reset([seeds[started]], np.array([world]))
                actor.begin(world, seeds[started])
                recorders[world] = _Recorder(worlds, world, started, seeds[started])
                started += 1
        action = actor.act()
        worlds.step(action)
        # Copied once for all worlds: the recorders keep rows of it.
        seen = _Seen(worlds)
        # What has fallen off the table would fall for the rest of the episode.
        ended, over = seen.done | seen.truncated | worlds.hopeless, actor.finished
        for world, recorder in enumerate(recorders):
            if recorder is not None:
                recorder.add(action[world], seen, bool(over[world]))
                if ended[world] or recorder.idle >= _TAIL_STEPS:
                    finished[recorder.order] = recorder.episode(worlds, info)
                    recorders[world] = None
        while yielded in finished:
            yield finished.pop(yielded)
            yielded += 1


class _ScriptActor:
    """A script in each world."""

    def __init__(self, worlds: Worlds, policy: ScriptedPolicy) -> None:
        self._worlds, self._policy = worlds, policy

    def begin(self, world: int, seed: int) -> None:
        goal = self._worlds.desired_goal[world].copy()
        self._policy.begin(world, self._worlds.state, goal, seed)

    def act(self) -> np.ndarray:
        return self._policy.act(self._worlds.state)

    @property
    def finished(self) -> np.ndarray:
        return self._policy.finished


class _RandomActor:
    """Uniform actions, in each world from a stream of its own."""

    def __init__(self, worlds: AnyWorlds) -> None:
        self._streams = [np.random.default_rng() for _ in range(worlds.count)]
        self._action_dim = worlds.action_dim
        self.finished = np.zeros(worlds.count, bool)

    def begin(self, world: int, seed: int) -> None:
        # Apart from the stream that the world itself draws its start from.
        self._streams[world] = np.random.default_rng([seed, 2])

    def act(self) -> np.ndarray:
        rows = [stream.uniform(-1.0, 1.0, self._action_dim) for stream in self._streams]
        return np.stack(rows).astype(np.float32)


class _Seen:
    """All worlds after one step."""

    def __init__(self, worlds: AnyWorlds) -> None:
        self.state = worlds.state.copy()
        self.done = worlds.done.copy()
        self.truncated = worlds.truncated.copy()
        if isinstance(worlds, GymWorlds):
            self.observation = worlds.observation.copy()
            self.achieved_goal = worlds.achieved_goal.copy()
            self.success = worlds.success.copy()


class _Recorder:
    """One episode in progress."""

    def __init__(self, worlds: AnyWorlds, world: int, order: int, seed: int) -> None:
        self.order, self.idle = order, 0
        self._world, self._seed = world, seed
        self._goal = worlds.desired_goal[world].copy()
        self._seen = [_Seen(worlds)]
        self._actions: list[np.ndarray] = []

    def add(self, action: np.ndarray, seen: _Seen, over: bool) -> None:
        """Add a step; ``over`` if the actor has finished."""
        self._actions.append(action)
        self._seen.append(seen)
        self.idle += over

    def _column(self, name: str) -> np.ndarray:
        return np.stack([getattr(seen, name)[self._world] for seen in self._seen])

    def episode(self, worlds: AnyWorlds, info: Mapping[str, Scalar]) -> Episode:
        """Return the whole of it."""
        state = self._column("state")
        if isinstance(worlds, Worlds):
            # Of this episode's states alone: the last bit of what numpy computes for a row may
            # depend on how many rows there are.
            observation = worlds.task.observe(state)
            achieved = worlds.task.achieved_goal(state)
            success = is_success(achieved, self._goal)
        else:
            observation, achieved, success = map(
                self._column, ("observation", "achieved_goal", "success")
            )
        done = self._column("done")[1:]
        truncated = np.zeros(len(done), bool)
        truncated[-1] = not done[-1]
        desired = np.broadcast_to(self._goal, achieved[1:].shape)
        return Episode(
            observation=observation,
            achieved_goal=achieved,
            desired_goal=self._goal,
            action=np.stack(self._actions).astype(np.float32),
            reward=worlds.compute_reward(achieved[1:], desired),
            done=done,
            truncated=truncated,
            success=success,
            sim_state=state,
            seed=self._seed,
            info={"task": worlds.name, **info},
        )
