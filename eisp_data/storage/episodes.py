"""``meta/episodes``: one row per episode, saying where its rows and frames are.

These files are the truth about which episodes a dataset holds: a batch is committed when its
file appears, and ``info.json`` is only a summary that can be written again from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from eisp_data.episode import Scalar
from eisp_data.errors import DataError
from eisp_data.storage.parquet import column_names, read_parquet
from eisp_data.storage.schema import CHUNK_SIZE, DATA_PATH, EPISODES_PATH, VIDEO_PATH, video_key
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.stats import Stats

POINTERS = ("episode_index", "length", "data/chunk_index", "data/file_index", "dataset_from_index")
LATEST_S = 1e9
"""No video is as long, and no decoder can seek to what damage makes of some times."""


@dataclass(frozen=True)
class EpisodeIndex:
    """Where the E episodes of a dataset are; every array has one entry per episode, in order."""

    root: Path
    length: np.ndarray
    """(E,) int64: rows, the T of the episode."""
    data_file: np.ndarray
    """(E, 2) int64: chunk and file index of the rows."""
    first_row: np.ndarray
    """(E,) int64: the episode's first ``index`` in the dataset."""
    video_file: Mapping[str, np.ndarray]
    """Camera to (E, 2) int64: chunk and file index of the frames."""
    video_start_s: Mapping[str, np.ndarray]
    """Camera to (E,) float64: where the episode begins in that file, seconds."""
    tables: Sequence[Path]
    """The files of ``meta/episodes`` that these rows came from."""
    stale: Sequence[Path]
    """Files of ``meta/episodes`` that only repeat earlier rows: an interrupted compaction."""

    def __len__(self) -> int:
        """Return E."""
        return len(self.length)

    def data_path(self, episode: int) -> Path:
        """Return the parquet file of an episode's rows."""
        chunk, file = self.data_file[episode]
        return self.root / DATA_PATH.format(chunk_index=chunk, file_index=file)

    def video_path(self, episode: int, camera: str) -> Path:
        """Return the video of an episode's frames."""
        chunk, file = self.video_file[camera][episode]
        key = video_key(camera)
        return self.root / VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file)


def position(number: int) -> tuple[int, int]:
    """Return the chunk and file index of the dataset's file ``number``, counted from 0."""
    return number // CHUNK_SIZE, number % CHUNK_SIZE


def read_index(root: Path) -> EpisodeIndex:
    """Read ``meta/episodes``; DataError if a file is damaged or episodes are missing."""
    paths = sorted((root / "meta/episodes").glob("chunk-*/file-*.parquet"))
    kept: list[pa.Table] = []
    tables, stale = [], []
    expected = 0
    for path in paths:
        table = read_parquet(path, _pointer_columns(path))
        numbers = _integers(table, "episode_index", path)
        if len(numbers) and numbers[-1] < expected:
            stale.append(path)
            continue
        if not np.array_equal(numbers, np.arange(expected, expected + len(numbers))):
            raise DataError(
                f"{path}: episode_index: expected {expected} and upwards in steps of one; "
                f"got {numbers[:5].tolist()}…"
            )
        expected += len(numbers)
        kept.append(table)
        tables.append(path)
    return _collect(root, kept, tables, stale)


def _collect(
    root: Path, kept: list[pa.Table], tables: list[Path], stale: list[Path]
) -> EpisodeIndex:
    def column(name: str) -> np.ndarray:
        parts = [_integers(table, name, path) for table, path in zip(kept, tables, strict=True)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def seconds(name: str) -> np.ndarray:
        parts = [_seconds(table, name, path) for table, path in zip(kept, tables, strict=True)]
        return np.concatenate(parts) if parts else np.zeros(0)

    names = kept[0].column_names if kept else []
    prefix, suffix = "videos/observation.images.", "/from_timestamp"
    cameras = [n[len(prefix) : -len(suffix)] for n in names if n.endswith(suffix)]
    return EpisodeIndex(
        root=root,
        length=column("length"),
        data_file=np.stack([column("data/chunk_index"), column("data/file_index")], axis=-1),
        first_row=column("dataset_from_index"),
        video_file={
            c: np.stack(
                [column(f"{prefix}{c}/chunk_index"), column(f"{prefix}{c}/file_index")], axis=-1
            )
            for c in cameras
        },
        video_start_s={c: seconds(f"{prefix}{c}{suffix}") for c in cameras},
        tables=tables,
        stale=stale,
    )


def _pointer_columns(path: Path) -> list[str]:
    names = column_names(path)
    missing = [name for name in POINTERS if name not in names]
    if missing:
        raise DataError(f"{path}: column(s) {missing} are missing")
    return [*POINTERS, *(n for n in names if n.startswith("videos/observation.images."))]


def _integers(table: pa.Table, name: str, path: Path) -> np.ndarray:
    try:
        column = table[name]
        if column.null_count:
            raise DataError(f"{path}: column {name} has empty cells")
        return column.to_numpy().astype(np.int64, casting="same_kind")
    except (KeyError, TypeError, pa.ArrowException):
        raise DataError(f"{path}: column {name} is missing or does not hold integers") from None


def _seconds(table: pa.Table, name: str, path: Path) -> np.ndarray:
    try:
        values = table[name].to_numpy().astype(np.float64, casting="same_kind")
    except (KeyError, TypeError, pa.ArrowException):
        raise DataError(f"{path}: column {name} is missing or does not hold numbers") from None
    if not ((values >= 0) & (values < LATEST_S)).all():  # an empty cell has become NaN
        raise DataError(f"{path}: column {name} has cells that are empty or no time in a video")
    return values


def check_cameras(index: EpisodeIndex, spec: DatasetSpec) -> None:
    """Raise DataError unless ``meta/episodes`` says where the frames of every camera are."""
    for camera in spec.cameras if len(index) else ():
        if camera not in index.video_file:
            raise DataError(f"{index.root}/meta/episodes: no video of camera {camera!r}")


def read_seeds(root: Path) -> list[int]:
    """Return the seed of each episode of a dataset, in order."""
    return [
        int(seed)
        for path in read_index(root).tables
        for seed in _integers(read_parquet(path, ["seed"]), "seed", path)
    ]


def episode_row(
    spec: DatasetSpec,
    *,
    episode: int,
    first_row: int,
    data_file: int,
    video: Mapping[str, tuple[int, int]],
    success: np.ndarray,
    reward: np.ndarray,
    seed: int,
    info: Mapping[str, Scalar],
) -> dict[str, Any]:
    """Return an episode's row of ``meta/episodes`` without its statistics.

    Beside LeRobot's pointers it has what one filters episodes by: success at the last
    observation, return, seed, policy and operator.

    Args:
        spec: the dataset's.
        episode: its number in the dataset.
        first_row: its first ``index``.
        data_file: number of the file that holds its rows.
        video: camera to the number of the video file and the first frame in it.
        success: (T,) bool, ``next.success``.
        reward: (T,) float32.
        seed: of the episode.
        info: of the episode.
    """
    chunk, file = position(data_file)
    row: dict[str, Any] = {
        "episode_index": episode,
        "tasks": [spec.instruction],
        "length": len(reward),
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": first_row,
        "dataset_to_index": first_row + len(reward),
        "success": bool(success[-1]),
        "return": float(reward.sum(dtype=np.float64)),
        "seed": int(seed),
        "policy": str(info.get("policy", "")),
        "operator": str(info.get("operator", "")),
    }
    for camera, (number, frame) in video.items():
        key = f"videos/{video_key(camera)}"
        row[f"{key}/chunk_index"], row[f"{key}/file_index"] = position(number)
        row[f"{key}/from_timestamp"] = frame / spec.fps
        row[f"{key}/to_timestamp"] = (frame + len(reward)) / spec.fps
    return row


def episode_table(
    rows: Sequence[Mapping[str, Any]], stats: Sequence[Mapping[str, Stats]], number: int
) -> pa.Table:
    """Return the ``meta/episodes`` table of a batch.

    Args:
        rows: one mapping per episode, plain values, the same keys in each.
        stats: one mapping per episode, column to its statistics.
        number: which file of the dataset this will be.
    """
    chunk, file = position(number)
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    for name in stats[0]:
        for stat in stats[0][name]:
            columns[f"stats/{name}/{stat}"] = [s[name][stat].tolist() for s in stats]
    columns["meta/episodes/chunk_index"] = [chunk] * len(rows)
    columns["meta/episodes/file_index"] = [file] * len(rows)
    return pa.table(columns)


def episodes_path(root: Path, number: int) -> Path:
    """Return the path of file ``number`` of ``meta/episodes``."""
    chunk, file = position(number)
    return root / EPISODES_PATH.format(chunk_index=chunk, file_index=file)
