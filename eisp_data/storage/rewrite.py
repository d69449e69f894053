"""Episodes of one or more datasets into a new one, without decoding a single frame.

Rows are renumbered and packed into large files, videos are copied as they are, statistics of rows
are worked out anew. The new dataset appears under its name only when it is whole.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow.parquet as pq

from eisp_data.errors import DataError
from eisp_data.storage.batch import PART_BYTES
from eisp_data.storage.episodes import (
    EpisodeIndex,
    episode_row,
    episode_table,
    episodes_path,
    position,
)
from eisp_data.storage.files import make_partial, sync, write_json
from eisp_data.storage.meta import SIDECAR_PATH, info_json, sidecar_json, stats_json, write_tasks
from eisp_data.storage.parquet import column_names, read_parquet
from eisp_data.storage.reader import runs
from eisp_data.storage.rows import column_values, read_rows, write_rows
from eisp_data.storage.schema import (
    DATA_PATH,
    SIDECAR_COLUMN,
    VIDEO_PATH,
    column_widths,
    video_key,
)
from eisp_data.storage.sidecar import decode
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.stats import QUANTILES, Stats, aggregate, column_stats, image_stats
from eisp_data.storage.video import decode_video


@dataclass(frozen=True)
class Source:
    """The episodes that are wanted of a dataset."""

    index: EpisodeIndex
    keep: Sequence[int]
    """Their numbers, rising."""


@dataclass
class _Part:
    """Episodes gathered for the next data file."""

    columns: list[dict[str, np.ndarray]] = field(default_factory=list)
    sidecars: list[str] = field(default_factory=list)
    video: list[dict[str, tuple[int, int]]] = field(default_factory=list)
    stats: list[dict[str, Stats]] = field(default_factory=list)
    bytes: int = 0


def rewrite(
    sources: Sequence[Source], to: Path, spec: DatasetSpec, recipe: Mapping[str, Any]
) -> None:
    """Make a dataset of the wanted episodes, in order.

    Columns that are not the spec's (LeRobot's tools can add such) are not copied.

    Args:
        sources: datasets of the same spec; their episodes must be readable.
        to: the new dataset's folder, which must not be there.
        spec: of the sources and the new dataset.
        recipe: of the new dataset; each episode's sidecar keeps the recipe that it had.
    """
    with Rewriter(to, spec, recipe) as rewriter:
        for source in sources:
            _add_all(rewriter, source, spec)


def _add_all(rewriter: Rewriter, source: Source, spec: DatasetSpec) -> None:
    index, wanted = source.index, set(source.keep)
    known = _video_stats(index, spec)
    kinds = column_widths(spec)
    for first, stop in runs(index):
        chosen = [e for e in range(first, stop) if e in wanted]
        if not chosen:
            continue
        path = index.data_path(first)
        table = read_rows(path, [*kinds, SIDECAR_COLUMN])
        columns = {n: column_values(table, n, *kind, path) for n, kind in kinds.items()}
        for episode in chosen:
            place = np.flatnonzero(columns["episode_index"] == episode)
            rows = slice(int(place[0]), int(place[-1]) + 1)
            videos = {
                camera: (
                    index.video_path(episode, camera),
                    round(float(index.video_start_s[camera][episode]) * spec.fps),
                )
                for camera in spec.cameras
            }
            rewriter.add(
                {name: values[rows] for name, values in columns.items()},
                table[SIDECAR_COLUMN][rows.start].as_py(),
                videos,
                known.get(episode),
            )


class Rewriter:
    """Takes episodes as rows and puts them into a new dataset, whole at the end of the ``with``."""

    def __init__(self, to: Path, spec: DatasetSpec, recipe: Mapping[str, Any]) -> None:
        """Begin a dataset at ``to``, which must not be there."""
        if to.exists():
            raise DataError(f"{to}: exists already; choose another folder")
        self._to, self._spec, self._recipe = to, spec, recipe
        self._rows: list[dict[str, Any]] = []
        self._stats: list[dict[str, Stats]] = []
        self._frames = self._data_files = 0
        self._videos: dict[tuple[str, Path], int] = {}
        self._part = _Part()

    def __enter__(self) -> Self:
        """Return the rewriter, its folder made."""
        self._root = make_partial(self._to)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Move the dataset into place, or remove all of it if anything went wrong."""
        try:
            if error is None:
                self._finish()
            elif isinstance(error, OSError):
                raise DataError(f"{self._to}: {error.strerror or error}; nothing was left there")
        except OSError as full:
            reason = full.strerror or full
            raise DataError(f"{self._to}: {reason}; nothing was left there") from full
        finally:
            shutil.rmtree(self._root, ignore_errors=True)

    def _finish(self) -> None:
        self._flush()
        if not self._rows:
            raise DataError(f"{self._to}: there are no episodes to write")
        self._write_meta(self._recipe)
        for path in sorted(self._root.rglob("*"), reverse=True):
            sync(path)
        os.rename(self._root, self._to)
        sync(self._to.parent)

    def add(
        self,
        columns: dict[str, np.ndarray],
        sidecar: str,
        videos: Mapping[str, tuple[Path, int]],
        video_stats: dict[str, Stats] | None = None,
    ) -> None:
        """Append one episode.

        Args:
            columns: all numeric columns of its rows; the index columns are numbered anew.
            sidecar: its sidecar string.
            videos: camera to the file that holds its frames and its first frame there.
            video_stats: statistics of its frames; worked out from them if not known.
        """
        steps = len(columns["index"])
        if video_stats is None:
            video_stats = {
                video_key(camera): image_stats(self._frames_of(camera, path, start, steps))
                for camera, (path, start) in videos.items()
            }
        self._part.columns.append(columns)
        self._part.sidecars.append(sidecar)
        self._part.video.append(self._copy_videos(videos))
        self._part.stats.append(dict(video_stats))
        self._part.bytes += sum(values.nbytes for values in columns.values())
        if self._part.bytes > PART_BYTES:
            self._flush()

    def _frames_of(self, camera: str, path: Path, start: int, steps: int) -> np.ndarray:
        """Return an episode's (T, H, W, 3) frames of a camera."""
        size = self._spec.cameras[camera]
        return np.stack(list(decode_video(path, start, start + steps, self._spec.fps, size)))

    def _copy_videos(self, videos: Mapping[str, tuple[Path, int]]) -> dict[str, tuple[int, int]]:
        """Return camera to (new file, first frame), having copied the files where needed."""
        place = {}
        for camera, (source, start) in videos.items():
            if (camera, source) not in self._videos:
                number = sum(1 for other, _ in self._videos if other == camera)
                target = self._path(VIDEO_PATH, number, video_key=video_key(camera))
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
                self._videos[camera, source] = number
            place[camera] = (self._videos[camera, source], start)
        return place

    def _flush(self) -> None:
        """Write what was gathered as one data file."""
        part, self._part = self._part, _Part()
        if not part.columns:
            return
        number, self._data_files = self._data_files, self._data_files + 1
        lengths = [len(own["index"]) for own in part.columns]
        first = len(self._rows)
        for offset, own in enumerate(part.columns):
            steps = lengths[offset]
            own["episode_index"] = np.full(steps, first + offset)
            own["index"] = self._frames + np.arange(steps)
            own["task_index"] = np.zeros(steps, dtype=np.int64)
            sidecar = decode(part.sidecars[offset], f"episode {first + offset}")
            self._rows.append(
                episode_row(
                    self._spec,
                    episode=first + offset,
                    first_row=self._frames,
                    data_file=number,
                    video=part.video[offset],
                    success=own["next.success"],
                    reward=own["next.reward"],
                    seed=sidecar.seed,
                    info=sidecar.info,
                )
            )
            self._frames += steps
        for name in part.columns[0]:
            every = column_stats([columns[name] for columns in part.columns])
            for stats, column in zip(part.stats, every, strict=True):
                stats[name] = column
        self._stats += part.stats
        merged = {n: np.concatenate([own[n] for own in part.columns]) for n in part.columns[0]}
        path = self._path(DATA_PATH, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_rows(path, merged, part.sidecars, lengths)

    def _write_meta(self, recipe: Mapping[str, Any]) -> None:
        path = episodes_path(self._root, 0)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(episode_table(self._rows, self._stats, 0), path, write_page_checksum=True)
        totals = {name: aggregate([own[name] for own in self._stats]) for name in self._stats[0]}
        write_json(self._root / "meta/stats.json", stats_json(totals))
        write_json(self._root / SIDECAR_PATH, sidecar_json(self._spec, recipe))
        write_tasks(self._root, self._spec.instruction)
        info = info_json(self._spec, len(self._rows), self._frames)
        write_json(self._root / "meta/info.json", info)

    def _path(self, template: str, number: int, **names: str) -> Path:
        chunk, file = position(number)
        return self._root / template.format(chunk_index=chunk, file_index=file, **names)


def _video_stats(index: EpisodeIndex, spec: DatasetSpec) -> dict[int, dict[str, Stats]]:
    """Return each episode's statistics of its frames, of the episodes whose row has them all."""
    found: dict[int, dict[str, Stats]] = {}
    names = [
        (video_key(camera), stat)
        for camera in spec.cameras
        for stat in ("min", "max", "mean", "std", "count", *QUANTILES)
    ]
    for path in index.tables if spec.cameras else ():
        present = column_names(path)
        if any(f"stats/{key}/{stat}" not in present for key, stat in names):
            continue
        table = read_parquet(path, ["episode_index", *(f"stats/{k}/{s}" for k, s in names)])
        for row in table.to_pylist():
            own: dict[str, Stats] = {video_key(camera): {} for camera in spec.cameras}
            for key, stat in names:
                own[key][stat] = np.asarray(row[f"stats/{key}/{stat}"])
            found[row["episode_index"]] = own
    return found
