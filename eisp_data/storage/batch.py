"""A batch of episodes on its way to the disk: checked, turned into columns, staged as files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage import sidecar
from eisp_data.storage.episodes import (
    EpisodeIndex,
    check_cameras,
    episode_row,
    episode_table,
    position,
)
from eisp_data.storage.files import sync
from eisp_data.storage.parquet import column_names
from eisp_data.storage.rows import write_rows
from eisp_data.storage.schema import (
    CHUNK_SIZE,
    DATA_PATH,
    EPISODES_PATH,
    SIM_STATE_COLUMN,
    VIDEO_PATH,
    column_widths,
    video_key,
)
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.stats import Stats, column_stats, image_stats
from eisp_data.storage.video import encode_video

PART_BYTES = 90_000_000
"""Raw bytes of rows in one data file, below LeRobot's 100 MB."""
PART_PIXELS = 2_000_000_000
"""Raw bytes of frames in one video file: about 200 MB of video at most."""


@dataclass(frozen=True)
class Batch:
    """Episodes that go into one set of files, with their first number in the dataset."""

    episodes: Sequence[Episode]
    extras: Sequence[Mapping[str, np.ndarray]]
    sidecars: Sequence[str]
    columns: Sequence[dict[str, np.ndarray]]
    """Per episode: numeric columns but ``index``, each (T,) or (T, D)."""
    first_episode: int

    @property
    def num_frames(self) -> int:
        """Return how many rows the batch has."""
        return sum(len(episode) for episode in self.episodes)

    def stats(self) -> list[dict[str, Stats]]:
        """Return each episode's statistics of every column and camera, ``index`` still missing."""
        stats: list[dict[str, Stats]] = [{} for _ in self.episodes]
        for name in self.columns[0]:
            for own, column in zip(
                stats, column_stats([c[name] for c in self.columns]), strict=True
            ):
                own[name] = column
        for own, episode in zip(stats, self.episodes, strict=True):
            for camera, frames in episode.images.items():
                own[video_key(camera)] = image_stats(frames[:-1])
        return stats


def prepare(
    spec: DatasetSpec,
    recipe: Mapping[str, object],
    episodes: Sequence[Episode],
    extras: Sequence[Mapping[str, np.ndarray]] | None,
    first_episode: int,
) -> Batch:
    """Check every episode and turn it into columns; DataError, naming it, before any file."""
    extras = [{} for _ in episodes] if extras is None else extras
    if len(extras) != len(episodes):
        raise DataError(f"extras: {len(extras)} mappings for {len(episodes)} episodes")
    shared = sidecar.dataset_part(spec, recipe)
    sidecars, columns = [], []
    for number, (episode, extra) in enumerate(zip(episodes, extras, strict=True)):
        try:
            spec.check(episode)
            _check_extras(spec, extra, len(episode))
            sidecars.append(sidecar.encode(episode, shared))
        except DataError as error:
            raise DataError(f"episode {number} of the batch: {error}") from None
        columns.append(_columns(spec, episode, extra, first_episode + number))
    return Batch(episodes, extras, sidecars, columns, first_episode)


def _check_extras(spec: DatasetSpec, extra: Mapping[str, np.ndarray], steps: int) -> None:
    if set(extra) != set(spec.extras):
        raise DataError(f"extras: the dataset holds {sorted(spec.extras)}; got {sorted(extra)}")
    for name, values in extra.items():
        if values.shape != (steps, spec.extras[name]) or values.dtype != np.float32:
            raise DataError(
                f"extra {name!r}: expected ({steps}, {spec.extras[name]}) float32; "
                f"got {values.shape} {values.dtype}"
            )
        if not np.isfinite(values).all():
            raise DataError(f"extra {name!r}: not finite")


def _columns(
    spec: DatasetSpec, episode: Episode, extra: Mapping[str, np.ndarray], number: int
) -> dict[str, np.ndarray]:
    steps = len(episode)
    frame = np.arange(steps)
    every = {
        "observation.state": episode.observation[:-1, : spec.proprio_dim],
        "observation.environment_state": episode.observation[:-1, spec.proprio_dim :],
        "observation.achieved_goal": episode.achieved_goal[:-1],
        "observation.desired_goal": np.broadcast_to(episode.desired_goal, (steps, spec.goal_dim)),
        "action": episode.action,
        "next.reward": episode.reward,
        "next.done": episode.done,
        "next.truncated": episode.truncated,
        "next.success": episode.success[1:],
        SIM_STATE_COLUMN: episode.sim_state[:-1],
        **extra,
        "timestamp": (frame / spec.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(steps, number),
        "task_index": np.zeros(steps, dtype=np.int64),
    }
    return {name: every[name] for name in column_widths(spec) if name in every}


def split(batch: Batch, spec: DatasetSpec) -> Iterator[Batch]:
    """Cut a batch between episodes into parts small enough for one file each."""
    row = sum(np.dtype(kind).itemsize * width for kind, width in column_widths(spec).values())
    pixels = max((h * w * 3 for h, w in spec.cameras.values()), default=0)
    start, rows = 0, 0
    for stop, episode in enumerate(batch.episodes):
        rows += len(episode)
        if stop > start and (rows * row > PART_BYTES or rows * pixels > PART_PIXELS):
            yield _slice(batch, start, stop)
            start, rows = stop, len(episode)
    if start < len(batch.episodes):
        yield _slice(batch, start, len(batch.episodes))


def _slice(batch: Batch, start: int, stop: int) -> Batch:
    return Batch(
        batch.episodes[start:stop],
        batch.extras[start:stop],
        batch.sidecars[start:stop],
        batch.columns[start:stop],
        batch.first_episode + start,
    )


def stage(
    batch: Batch,
    stats: Sequence[dict[str, Stats]],
    spec: DatasetSpec,
    first_row: int,
    number: int,
    staging: Path,
) -> list[tuple[Path, Path]]:
    """Write a batch's files into ``staging``, synced; return (file, its place in the dataset).

    The order is the one to rename them in: ``meta/episodes``, which commits the batch, is last.
    Adds the statistics of ``index`` to ``stats``, now that the rows are numbered.
    """
    chunk, file = position(number)
    staged: list[tuple[Path, Path]] = []
    for camera in spec.cameras:
        path = staging / f"{camera}.mp4"
        written = encode_video(path, _frames(batch, camera), spec.fps)
        if written != batch.num_frames:
            raise DataError(f"camera {camera!r}: {written} frames for {batch.num_frames} rows")
        key = video_key(camera)
        target = VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file)
        staged.append((path, Path(target)))
    data = staging / "data.parquet"
    columns = {
        name: np.concatenate([own[name] for own in batch.columns]) for name in batch.columns[0]
    }
    columns["index"] = np.arange(first_row, first_row + batch.num_frames)
    # ``pages.py`` relies on this order when a footer is lost.
    columns = {name: columns[name] for name in column_widths(spec)}
    write_rows(data, columns, batch.sidecars, [len(episode) for episode in batch.episodes])
    staged.append((data, Path(DATA_PATH.format(chunk_index=chunk, file_index=file))))
    rows: list[dict[str, object]] = []
    frames = 0
    for episode, own in zip(batch.episodes, stats, strict=True):
        [own["index"]] = column_stats([first_row + np.arange(len(episode))])
        rows.append(
            episode_row(
                spec,
                episode=batch.first_episode + len(rows),
                first_row=first_row,
                data_file=number,
                video={camera: (number, frames) for camera in spec.cameras},
                success=episode.success[1:],
                reward=episode.reward,
                seed=episode.seed,
                info=sidecar.plain_info(episode.info),
            )
        )
        first_row += len(episode)
        frames += len(episode)
    table = staging / "episodes.parquet"
    pq.write_table(episode_table(rows, stats, number), table, write_page_checksum=True)
    staged.append((table, Path(EPISODES_PATH.format(chunk_index=chunk, file_index=file))))
    for path, _ in staged:
        sync(path)
    return staged


def _frames(batch: Batch, camera: str) -> Iterator[np.ndarray]:
    for episode in batch.episodes:
        yield from episode.images[camera][:-1]


def find_orphans(index: EpisodeIndex, spec: DatasetSpec) -> list[Path]:
    """Return the files of rows and frames that no episode points to: a killed batch leaves some.

    Raises:
        DataError: there are more than one batch leaves, all its files having one number.
    """
    orphans: list[Path] = []
    for folder, used in (
        ("data", {index.data_path(e) for e in range(len(index))}),
        *(
            (f"videos/{video_key(c)}", {index.video_path(e, c) for e in range(len(index))})
            for c in spec.cameras
        ),
    ):
        found = sorted((index.root / folder).glob("chunk-*/file-*"))
        orphans += [path for path in found if path not in used]
    if len({(path.parent.name, path.stem) for path in orphans}) > 1:
        raise DataError(
            f"{index.root}: meta/episodes has no episode for {len(orphans)} files, "
            f"{orphans[0].relative_to(index.root)} first, more than an interrupted batch leaves; "
            "run eisp-data repair first"
        )
    return orphans


def next_file(root: Path) -> int:
    """Return the number of the next file to write."""
    highest = -1
    for path in root.glob("**/chunk-*/file-*"):
        match = re.fullmatch(r"chunk-(\d+)/file-(\d+)", f"{path.parent.name}/{path.stem}")
        if match:
            highest = max(highest, int(match[1]) * CHUNK_SIZE + int(match[2]))
    return highest + 1


def check_columns(index: EpisodeIndex, spec: DatasetSpec) -> None:
    """Raise DataError if the dataset's own columns are gone: another tool wrote it anew."""
    check_cameras(index, spec)
    for path in index.tables:
        if "policy" not in column_names(path):
            raise DataError(
                f"{index.root}: was written anew by another tool, which cannot be resumed; "
                "rewrite it first with eisp-data merge"
            )
    for path in {index.data_path(e) for e in range(len(index))}:
        names = column_names(path)
        missing = [name for name in column_widths(spec) if name not in names]
        if missing:
            raise DataError(f"{path}: column(s) {missing} are missing")
