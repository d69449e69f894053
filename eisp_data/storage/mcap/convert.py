"""Recordings to a LeRobot dataset: deterministic, resumable, at a fixed rate."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.lerobot import DatasetSpec, DatasetWriter
from eisp_data.storage.mcap.assemble import ORIGIN, Assembler, Made, Origin, Rate
from eisp_data.storage.mcap.build import GOAL, REACHED, STATE, WORLD
from eisp_data.storage.mcap.collect import Clock
from eisp_data.storage.mcap.columns import age_columns, extra_widths
from eisp_data.storage.mcap.guess import guess_mapping, suggestion
from eisp_data.storage.mcap.mapping import Mapping, load_mapping
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.repair import repaired_path
from eisp_data.storage.mcap.sources import Recording, load
from eisp_data.storage.mcap.summary import refuse_sqlite
from eisp_data.storage.reader import read_sidecars

_BATCH_BYTES = 64 * 2**20
_BATCH_EPISODES = 100
_FINGERPRINT_BYTES = 2**20


@dataclass(frozen=True, kw_only=True)
class ConvertConfig:
    """How recordings become a dataset."""

    inputs: tuple[Path, ...]
    """MCAP files, or folders of them (ROS 2 bags are such folders), in this order."""
    to: Path
    """Folder of the LeRobot dataset to make."""
    mapping: Path | None = None
    """Mapping file (YAML), needed for ROS 2 bags; by default what the recording itself says."""
    rate_hz: int = 25
    """Rows per second of the dataset."""
    clock: Clock = "hardware"
    """Whose times count: the sensors' (hardware) or the recorder's (log)."""
    epsilon_m: float = 0.05
    """Norm of the goal error up to which a goal is met (the paper's Eq. 1)."""
    task: str = ""
    """Registry name of the task; by default what the mapping or the recording says."""
    instruction: str = ""
    """The task as one English sentence; by default what the mapping or the recording says."""
    robot_type: str = "real"
    """LeRobot's name for the kind of robot."""
    resume: bool = False
    """Go on with a conversion that was interrupted."""

    def __post_init__(self) -> None:
        if not 1 <= self.rate_hz <= 1000:
            raise ConfigError(f"rate_hz must be 1 to 1000, got {self.rate_hz}")
        if not 0 < self.epsilon_m < float("inf"):
            raise ConfigError(f"epsilon_m must be above 0, got {self.epsilon_m}")
        if self.clock not in ("hardware", "log"):
            raise ConfigError(f"clock {self.clock!r}: choose one of hardware, log")
        if not self.inputs:
            raise ConfigError("no input: name at least one MCAP file or folder")


@dataclass
class ConvertReport:
    """What a conversion did."""

    episodes: int = 0
    """Episodes in the dataset, those of earlier runs included."""
    frames: int = 0
    """Rows in the dataset."""
    written: int = 0
    """Episodes that this run wrote."""
    lines: list[str] = field(default_factory=list)
    """Gaps, drops, damage and everything left out, one line each."""


def find_inputs(inputs: tuple[Path, ...]) -> tuple[list[Path], list[str]]:
    """Return the MCAP files: those named, and those in the folders named, in order of name.

    None comes twice. In a folder the repaired copy of a file takes its place; the lines say so.
    """
    found: dict[Path, Path] = {}
    lines: list[str] = []
    for path in inputs:
        if path.is_dir():
            inside = sorted(path.rglob("*.mcap"))
            if not inside:
                refuse_sqlite(path)
                raise DataError(f"{path}: no .mcap file in this folder")
        elif path.exists():
            inside = [path]
        else:
            raise DataError(f"{path}: no such file or folder")
        for file in inside:
            copy = repaired_path(file)
            if copy in inside:
                lines.append(f"{file.name}: left out for its repaired copy, {copy.name}")
            else:
                found.setdefault(file.resolve(), file)
    return list(found.values()), lines


def convert(
    config: ConvertConfig, progress: Callable[[int], None] = lambda episodes: None
) -> ConvertReport:
    """Convert recordings into a dataset.

    Files that were cut off or are damaged give the episodes that can be read, and the report says
    what is missing. ``progress`` is called with the number of episodes after each batch.

    Raises:
        DataError: a file cannot be read or does not fit the others; nothing in them can be used;
            or ``to`` holds a dataset and ``resume`` is not set. Episodes that were written before
            stay, as a whole dataset, and ``resume`` goes on from there.
        ConfigError: the mapping or a setting is wrong.
    """
    paths, left_out = find_inputs(config.inputs)
    rate = Rate(config.rate_hz, config.epsilon_m, config.clock)
    mapping = _mapping(config, paths[0])
    report = ConvertReport()
    with McapLog(paths[0]) as log:
        first = load(log, mapping, config.clock)
    spec = _spec(config, mapping, first)
    recipe = _recipe(config, mapping, first, paths)
    with DatasetWriter(config.to, spec, recipe, resume=config.resume) as writer:
        before = writer.num_episodes
        done: Counter[Origin] = Counter(
            tuple(sidecar.info.get(name) for name in ORIGIN) for sidecar in read_sidecars(config.to)
        )
        made = _made(paths, first, mapping, rate, spec.task, done, report)
        for batch in _batches(made):
            writer.write([m.episode for m in batch], [m.extras for m in batch])
            for m in batch:
                report.lines += m.lines
            progress(writer.num_episodes)
        report.episodes, report.frames = writer.num_episodes, writer.num_frames
        report.written = writer.num_episodes - before
    if not report.episodes:
        why = f": {report.lines[0]}" if report.lines else ""
        raise DataError(f"{paths[0]}: no episode could be made of it{why}")
    report.lines += left_out
    return report


def suggested_mapping(config: ConvertConfig) -> str:
    """Return the text of a mapping file for the first recording, to be edited by hand."""
    with McapLog(find_inputs(config.inputs)[0][0]) as log:
        return suggestion(log)


def _made(
    paths: list[Path],
    first: Recording,
    mapping: Mapping,
    rate: Rate,
    task: str,
    done: Counter[Origin],
    report: ConvertReport,
) -> Iterator[Made]:
    """Yield the episodes of all files but those of ``done``; ``first`` is of the first file."""
    for number, path in enumerate(paths):
        with McapLog(path) as log:
            recording = load(log, mapping, rate.clock) if number else first
            assembler = Assembler(log, recording, rate, task)
            report.lines += [f"{path.name}: {problem}" for problem in recording.problems]
            yield from assembler.episodes(done)
            report.lines += assembler.lines


def _batches(made: Iterator[Made]) -> Iterator[list[Made]]:
    batch: list[Made] = []
    size = 0
    for one in made:
        batch.append(one)
        size += sum(frames.nbytes for frames in one.episode.images.values())
        size += one.episode.observation.nbytes + one.episode.action.nbytes
        if size >= _BATCH_BYTES or len(batch) >= _BATCH_EPISODES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _mapping(config: ConvertConfig, path: Path) -> Mapping:
    if config.mapping is not None:
        return load_mapping(config.mapping)
    with McapLog(path) as log:
        return guess_mapping(log)


def _names(recording: Recording, role: str) -> list[str]:
    return [name for s in recording.sources if s.stream.to == role for name in s.names]


def _spec(config: ConvertConfig, mapping: Mapping, first: Recording) -> DatasetSpec:
    task = config.task or mapping.task or "recorded"
    state = len(_names(first, STATE))
    return DatasetSpec(
        task=task,
        instruction=config.instruction or mapping.instruction or f"Do the task: {task}.",
        fps=config.rate_hz,
        observation_dim=state + len(_names(first, WORLD)),
        proprio_dim=state,
        goal_dim=len(_names(first, REACHED)),
        action_dim=len(_names(first, "action")),
        cameras={
            source.stream.camera: source.image_size
            for source in first.sources
            if source.stream.camera is not None and source.image_size is not None
        },
        extras=extra_widths(first),
        robot_type=config.robot_type,
    )


def _recipe(
    config: ConvertConfig, mapping: Mapping, first: Recording, paths: list[Path]
) -> dict[str, Any]:
    """Return all that the dataset depends on, so that nothing else can be resumed into it."""
    columns = {role: _names(first, role) for role in (STATE, WORLD, REACHED, GOAL, "action")}
    ages = age_columns(first.sources)
    return {
        "source": "mcap",
        "files": [_fingerprint(path) for path in paths],
        "mapping": mapping.to_json(),
        "rules": {age: s.rule for age, s in zip(ages, first.sources, strict=True)},
        "columns": {role: names for role, names in columns.items() if names},
        "rate_hz": config.rate_hz,
        "clock": config.clock,
        "epsilon_m": config.epsilon_m,
    }


def _fingerprint(path: Path) -> dict[str, Any]:
    """Return name, size and a digest of both ends of a file: enough to tell it from another."""
    size = path.stat().st_size
    with path.open("rb") as file:
        digest = hashlib.sha256(file.read(_FINGERPRINT_BYTES))
        file.seek(max(0, size - _FINGERPRINT_BYTES))
        digest.update(file.read())
    return {"name": path.name, "bytes": size, "sha256_of_ends": digest.hexdigest()}
