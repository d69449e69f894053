"""``eisp-collect``: a dataset of demonstrations, or of random episodes of any environment."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from eisp_data.cli.run import fail, run
from eisp_data.cli.words import given, take
from eisp_data.config import at_least, load_yaml
from eisp_data.errors import ConfigError, EispError
from eisp_data.seeds import LAST_SEED, SEEDS_APART, episode_seeds

if TYPE_CHECKING:
    from eisp_data.episode import Episode
    from eisp_data.storage.lerobot import DatasetSpec, DatasetWriter
    from eisp_data.tasks.base import Task

_BATCH = 50
"""Episodes that are written at a time, and so the most that a kill loses."""
CONFIG_FILE = "meta/collect.yaml"
"""In the dataset; give it back with ``--config`` and another ``--output-dir``."""
_NOT_OF_THE_DATA = ("output_dir", "resume")
"""Not saved: a push would publish the path, and what was resumed here starts anew elsewhere."""


@dataclass(frozen=True)
class EnvConfig:
    """An environment from elsewhere."""

    id: str | None = None
    """A registered Gymnasium GoalEnv in place of --task, for example FetchPickAndPlace-v4, or
    MODULE:ID for one that MODULE registers. It is explored at random."""


@dataclass(frozen=True)
class CollectConfig:
    """What to collect, and where to."""

    output_dir: Path
    """Folder of the dataset."""
    task: str | None = None
    """stack, push4, open_drawer or store; open_drawer_image and store_image are the last two with
    the camera images that their image variants are learned from."""
    env: EnvConfig = field(default_factory=EnvConfig)
    policy: Literal["scripted", "oracle", "random"] | None = None
    """scripted: a clumsy demonstrator that does a random part of the task (the default);
    oracle: the same without noise, the whole task; random: uniform actions (the default of
    --env.id)."""
    episodes: int = 3000
    """Episodes in the dataset when done."""
    seed: int = 0
    """Datasets of different seeds share no episode, with each other or with an evaluation."""
    workers: int | None = None
    """Threads of the physics; all cores if left out. The data are the same with any number."""
    worlds: int = 64
    """Worlds that run at a time. The data are the same with any number."""
    resume: bool = False
    """Go on with the dataset in the output folder."""


def main() -> None:
    """Run ``eisp-collect``."""
    words = sys.argv[1:]
    try:
        default = _resumed(words)
    except EispError as error:
        fail(str(error))
    run(collect, words, "eisp-collect", config_file=True, default=default)


def _resumed(words: Sequence[str]) -> CollectConfig | None:
    """Return the settings that the dataset to go on with was begun with."""
    _, folder = take(words, "--output-dir")
    if not given(words, "--resume") or folder is None or not (Path(folder) / CONFIG_FILE).exists():
        return None
    # All but the folder has been saved.
    return load_yaml(CollectConfig, Path(folder) / CONFIG_FILE, absent=Path(folder))


def collect(config: CollectConfig) -> None:
    """Collect episodes of a task into a LeRobot dataset; print how many were successful."""
    _check(config)
    from tqdm import tqdm

    from eisp_data.config import save_yaml, to_plain
    from eisp_data.storage.episodes import read_seeds
    from eisp_data.storage.lerobot import DatasetWriter

    source = _EnvSource(config) if config.env.id else _TaskSource(config)
    recipe = {"policy": source.policy, "seed": config.seed, **source.recipe}
    try:
        writer = DatasetWriter(config.output_dir, source.spec, recipe, resume=config.resume)
        settings = {k: v for k, v in to_plain(config).items() if k not in _NOT_OF_THE_DATA}
        save_yaml(settings, config.output_dir / CONFIG_FILE)
    except OSError as error:
        raise ConfigError(f"cannot write to {config.output_dir}: {error.strerror}") from None
    with writer:
        seeds = missing_seeds(config.seed, read_seeds(config.output_dir), config.episodes)
        if seeds:
            done = writer.num_episodes
            with tqdm(desc="collecting", total=config.episodes, initial=done, unit="ep") as bar:
                _write(writer, source.episodes(seeds), bar)
    _report(config.output_dir)


def missing_seeds(seed: int, present: Sequence[int], episodes: int) -> list[int]:
    """Return the first seeds that a dataset lacks, as many as bring it to ``episodes``.

    Seeds 0, 1, 4 and 5 present and 7 episodes wanted: 2, 3 and 6.
    """
    here = set(present)
    lacking = (s for s in episode_seeds(seed, 0, SEEDS_APART) if s not in here)
    return list(islice(lacking, max(0, episodes - len(present))))


def _check(config: CollectConfig) -> None:
    if (config.task is None) == (config.env.id is None):
        raise ConfigError("give one of --task and --env.id")
    if config.env.id is not None and config.policy not in (None, "random"):
        raise ConfigError(f"--policy {config.policy} needs --task; with --env.id it is random")
    if not 1 <= config.episodes <= SEEDS_APART:
        raise ConfigError(f"--episodes must be 1 to {SEEDS_APART}; got {config.episodes}")
    if not 0 <= config.seed <= LAST_SEED:
        raise ConfigError(f"--seed must be 0 to {LAST_SEED}; got {config.seed}")
    at_least(1, {"--workers": config.workers, "--worlds": config.worlds})
    if config.resume and not (config.output_dir / "meta/info.json").exists():
        raise ConfigError(f"--resume: {config.output_dir} holds no dataset")
    if not config.resume and (config.output_dir / "meta/info.json").exists():
        raise ConfigError(
            f"{config.output_dir} already holds a dataset; add --resume to go on with it, or "
            "choose another --output-dir"
        )


class _TaskSource:
    """Episodes of one of our tasks."""

    def __init__(self, config: CollectConfig) -> None:
        from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
        from eisp_data.policies.script import Noise
        from eisp_data.tasks.images import CAMERA, IMAGE_SIZE, IMAGE_TASKS, state_task
        from eisp_data.tasks.registry import TASKS, get_task

        if config.task not in (known := [*TASKS, *IMAGE_TASKS]):
            raise ConfigError(f"unknown task {config.task!r}; choose one of {', '.join(known)}")
        self._config, self._task = config, get_task(state_task(str(config.task)))
        self.policy = config.policy or "scripted"
        self.spec = _task_spec(self._task)
        if config.task in IMAGE_TASKS:
            self.spec = replace(self.spec, cameras={CAMERA: IMAGE_SIZE})
        self.recipe: dict[str, Any] = {}
        if self.policy != "random":
            if self._task.name not in SCRIPTS:
                raise ConfigError(f"{self._task.name} has no script; give --policy random")
            self._script = SCRIPTS[self._task.name]
            oracle = self.policy == "oracle"
            self._noise = Noise() if oracle else DEMONSTRATOR[self._task.name]
            self.recipe["noise"] = asdict(self._noise)

    def episodes(self, seeds: Sequence[int]) -> Iterator[Episode]:
        if not self.spec.cameras:
            yield from self._states(seeds)
            return
        from eisp_data.sim.pixels import Pixels

        [(camera, size)] = self.spec.cameras.items()
        with Pixels(self._task, camera, *size) as pixels:
            for episode in self._states(seeds):
                yield replace(episode, images={camera: pixels.draw(episode.sim_state)})

    def _states(self, seeds: Sequence[int]) -> Iterator[Episode]:
        from eisp_data import collect
        from eisp_data.sim.worlds import Worlds

        worlds, threads = min(self._config.worlds, len(seeds)), self._config.workers
        if self.policy == "random":
            return collect.explore(Worlds(self._task, worlds, threads), seeds)
        return collect.collect(
            self._task, self._script, self._noise, seeds, worlds=worlds, threads=threads
        )


def _task_spec(task: Task) -> DatasetSpec:
    from eisp_data.sim.scene import CONTROL_HZ
    from eisp_data.storage.lerobot import DatasetSpec
    from eisp_data.tasks.base import GRIPPER_DIM

    return DatasetSpec(
        task=task.name,
        instruction=task.instruction,
        fps=CONTROL_HZ,
        observation_dim=task.paper.observation_dim,
        proprio_dim=GRIPPER_DIM,
        goal_dim=task.paper.goal_dim,
        action_dim=task.paper.action_dim,
        sim_state_dim=1 + task.model.nq + task.model.nv,
    )


class _EnvSource:
    """Random episodes of any GoalEnv."""

    policy = "random"

    def __init__(self, config: CollectConfig) -> None:
        from eisp_data.sim.gym_worlds import GymWorlds
        from eisp_data.storage.lerobot import DatasetSpec

        # Its copies step one after the other, so more of them would bring nothing.
        self._worlds = worlds = GymWorlds(str(config.env.id), 1)
        self.recipe: dict[str, Any] = {}
        self.spec = DatasetSpec(
            task=worlds.name,
            instruction=f"Reach the goal of {worlds.name}.",
            fps=worlds.fps,
            observation_dim=worlds.observation_dim,
            proprio_dim=worlds.observation_dim,
            goal_dim=worlds.goal_dim,
            action_dim=worlds.action_dim,
        )

    def episodes(self, seeds: Sequence[int]) -> Iterator[Episode]:
        from eisp_data.collect import explore

        return explore(self._worlds, seeds)


def _write(writer: DatasetWriter, episodes: Iterator[Episode], bar: Any) -> None:
    """Write episodes as they come, a batch at a time; those in hand also when interrupted."""
    pending: list[Episode] = []
    try:
        for episode in episodes:
            pending.append(episode)
            bar.update()
            if len(pending) == _BATCH:
                writer.write(pending)
                pending = []
    finally:
        if pending:
            writer.write(pending)


def _report(root: Path) -> None:
    from eisp_data.storage.summary import summary

    facts = summary(root)
    count, frames = facts["episodes"], facts["frames"]
    last, some = facts["success_at_last"], facts["success_at_any"]
    print(f"{count} episodes, {frames} frames in {root}")
    print(f"  successful  {last / count:.1%} at the last step, {some / count:.1%} at any step")
    print(f"  length      {facts['frames_per_episode']} steps, {frames / count:.0f} on average")
    print(f"  return      {facts['mean_return']:.1f} on average")


if __name__ == "__main__":
    main()
