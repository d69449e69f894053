"""The small files of ``meta/``: info, statistics, tasks, and the copy of spec and recipe."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from eisp_data.storage.episodes import EpisodeIndex, episodes_path, read_index
from eisp_data.storage.files import read_json, replace_atomically, sync
from eisp_data.storage.parquet import read_parquet
from eisp_data.storage.schema import (
    CHUNK_SIZE,
    CODEBASE_VERSION,
    DATA_FILE_MB,
    DATA_PATH,
    VIDEO_FILE_MB,
    VIDEO_PATH,
    features,
)
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.stats import Stats, aggregate
from eisp_data.storage.video import feature_info

SIDECAR_PATH = "meta/eisp/dataset.json"
"""Spec and recipe in plain sight; LeRobot's tools drop it, and the sidecar column replaces it."""
COMPACT_BELOW_BYTES = 64_000_000


def info_json(spec: DatasetSpec, episodes: int, frames: int) -> dict[str, Any]:
    """Return ``meta/info.json`` of a dataset with so many episodes and frames."""
    return {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": spec.robot_type,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": DATA_FILE_MB,
        "video_files_size_in_mb": VIDEO_FILE_MB,
        "fps": spec.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if spec.cameras else None,
        "features": features(spec, partial(feature_info, spec.fps)),
    }


def sidecar_json(spec: DatasetSpec, recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of ``SIDECAR_PATH``."""
    return {"eisp": 1, "spec": spec.to_json(), "recipe": dict(recipe)}


def stats_json(stats: Mapping[str, Stats]) -> dict[str, Any]:
    """Return ``meta/stats.json``."""
    return {
        name: {stat: values.tolist() for stat, values in column.items()}
        for name, column in stats.items()
    }


def write_tasks(root: Path, instruction: str) -> None:
    """Write ``meta/tasks.parquet`` with the one task of the dataset."""
    import pandas as pd

    table = pd.DataFrame({"task_index": [0]}, index=pd.Index([instruction], name="task"))
    replace_atomically(root / "meta/tasks.parquet", table.to_parquet)


def summed_stats(root: Path, index: EpisodeIndex) -> dict[str, Stats]:
    """Return the dataset's statistics: the summary if it is up to date, else from the episodes."""
    if not len(index):
        return {}
    path = root / "meta/stats.json"
    if path.exists():
        stored = read_json(path)
        if stored.get("index", {}).get("count") == [int(index.length.sum())]:
            return {
                name: {stat: np.asarray(values) for stat, values in column.items()}
                for name, column in stored.items()
            }
    return episode_stats_total(index)


def episode_stats_total(index: EpisodeIndex) -> dict[str, Stats]:
    """Aggregate the per-episode statistics that ``meta/episodes`` holds."""
    parts: dict[str, list[Stats]] = {}
    for path in index.tables:
        table = read_parquet(path)
        names = [n for n in table.column_names if n.startswith("stats/")]
        columns = {n: table[n].to_pylist() for n in names}
        for row in range(table.num_rows):
            episode: dict[str, Stats] = {}
            for name in names:
                _, feature, stat = name.split("/")
                episode.setdefault(feature, {})[stat] = np.asarray(columns[name][row])
            for feature, stats in episode.items():
                parts.setdefault(feature, []).append(stats)
    return {feature: aggregate(stats) for feature, stats in parts.items()}


def compact_episodes(root: Path) -> None:
    """Put ``meta/episodes`` into one file, as LeRobot's own writer leaves it.

    Its merge adds file numbers up wrongly if there are several. The one file replaces the first
    of them, then the others, which it repeats, are removed; ``read_index`` skips repetitions.
    """
    index = read_index(root)
    if sum(path.stat().st_size for path in index.tables) > COMPACT_BELOW_BYTES:
        return
    first = episodes_path(root, 0)
    if list(index.tables) != [first]:
        # By name: a rewrite orders the columns otherwise, and earlier versions had one more.
        tables = [read_parquet(path) for path in index.tables]
        table = pa.concat_tables(tables, promote_options="default")
        zeros = pa.array(np.zeros(table.num_rows, dtype=np.int64))
        for name in ("meta/episodes/chunk_index", "meta/episodes/file_index"):
            table = table.set_column(table.column_names.index(name), name, zeros)
        replace_atomically(
            first, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True)
        )
    repeated = [path for path in (*index.tables, *index.stale) if path != first]
    if repeated:
        sync(first.parent)  # a cut cable must not undo the renaming and keep the removals
    for path in repeated:
        path.unlink(missing_ok=True)
