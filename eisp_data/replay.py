"""Recorded episodes in the simulator again: compared with what was recorded, or drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from eisp_data.episode import Episode
from eisp_data.errors import ConfigError, DataError
from eisp_data.sim.pixels import Pixels
from eisp_data.sim.worlds import Worlds
from eisp_data.storage.episodes import read_index
from eisp_data.storage.lerobot import DatasetWriter, read_episodes, read_recipe, read_spec
from eisp_data.tasks.base import Task
from eisp_data.tasks.registry import get_task

_BATCH_BYTES = 200_000_000


@dataclass(frozen=True)
class Deviation:
    """How far a simulation ends up from a recording; the largest over all parts of the state."""

    episode: int
    one_step: float
    """After one action from each recorded state."""
    whole: float
    """After all actions so far from the first state."""
    at_step: int
    """The step with the largest ``whole``."""


def task_of(name: str, sim_state_dim: int) -> Task:
    """Return the task whose simulator states these are; DataError if they are not."""
    if sim_state_dim == 0:
        raise DataError("the dataset has no simulator states: a real robot's cannot be simulated")
    task = get_task(name)
    expected = 1 + task.model.nq + task.model.nv
    if expected != sim_state_dim:
        raise DataError(
            f"simulator states have {sim_state_dim} numbers; {name}'s have {expected}: "
            "they were recorded with another version of the scene"
        )
    return task


def chosen_episodes(
    root: Path, numbers: Sequence[int], images: bool = False
) -> Iterator[tuple[int, Episode]]:
    """Yield number and episode of the named ones, or of all; DataError for a number not there."""
    last = len(read_index(root)) - 1
    wanted = set(numbers) or set(range(last + 1))
    missing = sorted(number for number in wanted if not 0 <= number <= last)
    if missing:
        raise DataError(f"{root}: no episode {missing[0]}; there are 0 to {last}")
    episodes = islice(read_episodes(root, images=images), max(wanted, default=-1) + 1)
    for number, episode in enumerate(episodes):
        if number in wanted:
            yield number, episode


def replay(root: Path, numbers: Sequence[int] = ()) -> Iterator[Deviation]:
    """Simulate recorded episodes (all, if none is named) again and yield how far each deviates."""
    spec = read_spec(root)
    task = task_of(spec.task, spec.sim_state_dim)
    for number, episode in chosen_episodes(root, numbers):
        steps = len(episode)
        goals = np.broadcast_to(episode.desired_goal, (steps, spec.goal_dim))
        each = Worlds(task, steps)
        each.restore(episode.sim_state[:-1], goals)
        each.step(episode.action)
        one_step = np.abs(each.state - episode.sim_state[1:]).max()
        world = Worlds(task, 1, threads=1)
        world.restore(episode.sim_state[:1], goals[:1])
        apart = np.zeros(steps)
        for step in range(steps):
            world.step(episode.action[step : step + 1])
            apart[step] = np.abs(world.state[0] - episode.sim_state[step + 1]).max()
        yield Deviation(number, float(one_step), float(apart.max()), int(apart.argmax()))


def render(
    root: Path,
    to: Path,
    cameras: Mapping[str, tuple[int, int]],
    progress: Callable[[int], None] = lambda episodes: None,
) -> int:
    """Write a copy of a dataset with camera images, drawn from its simulator states.

    Args:
        root: the dataset; cameras that it has already are kept, encoded once more.
        to: the new dataset's folder.
        cameras: name of a camera of the scene to (height, width) in pixels.
        progress: called with the number of episodes drawn, after each.

    Returns:
        How many episodes were written.
    """
    old = read_spec(root)
    task = task_of(old.task, old.sim_state_dim)
    taken = sorted(set(cameras) & set(old.cameras))
    if taken:
        raise ConfigError(f"camera {taken[0]!r}: the dataset has it already")
    if old.extras:
        raise DataError(f"{root}: columns {sorted(old.extras)} of a recording cannot be carried")
    spec = replace(old, cameras={**old.cameras, **cameras})
    renderers = {name: Pixels(task, name, *size) for name, size in cameras.items()}
    count, batch, size = 0, list[Episode](), 0
    try:
        with DatasetWriter(to, spec, read_recipe(root)) as writer:
            for _, episode in chosen_episodes(root, (), images=bool(old.cameras)):
                images = {
                    name: renderer.draw(episode.sim_state) for name, renderer in renderers.items()
                }
                batch.append(replace(episode, images={**episode.images, **images}))
                size += sum(frames.nbytes for frames in images.values())
                if size > _BATCH_BYTES:
                    writer.write(batch)
                    batch, size = [], 0
                progress(writer.num_episodes + len(batch))
            writer.write(batch)
            count = writer.num_episodes
    finally:
        for renderer in renderers.values():
            renderer.close()
    return count
