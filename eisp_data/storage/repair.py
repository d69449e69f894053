"""A whole dataset out of a damaged one: every episode that can be read, in a copy.

Whole episodes are found in the data files themselves, whose first rows say how long each episode
is; ``meta/episodes`` is only needed to find their frames when another tool has packed the videos.
The original is read, never written; in place means that the copy takes its name once it is
whole, and the original stays beside it under another.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.files import no_writer, read_json
from eisp_data.storage.meta import SIDECAR_PATH
from eisp_data.storage.pages import recover_rows
from eisp_data.storage.parquet import group_rows, read_parquet
from eisp_data.storage.reader import build_episode
from eisp_data.storage.rewrite import Rewriter
from eisp_data.storage.rows import as_table, column_values, read_rows
from eisp_data.storage.schema import SIDECAR_COLUMN, VIDEO_PATH, column_widths, video_key
from eisp_data.storage.sidecar import Sidecar, decode
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.video import count_frames, decode_video


@dataclass
class RepairReport:
    """What a repair kept and what it could not."""

    copy: Path
    """The whole dataset."""
    original: Path
    """Where the damaged one is now."""
    episodes: int = 0
    frames: int = 0
    lost: list[str] = field(default_factory=list)
    """One line for each episode or file of which something could not be kept."""

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        kept = f"kept {self.episodes} episodes ({self.frames} frames) in {self.copy}"
        return [kept, *(f"lost {line}" for line in self.lost or ["nothing"])]


@dataclass(frozen=True)
class _Found:
    """A whole episode of a damaged dataset."""

    columns: dict[str, np.ndarray]
    sidecar: str
    videos: dict[str, tuple[Path, int]]


def repaired_path(root: Path) -> Path:
    """Return where ``repair`` puts its copy unless it is told."""
    return root.parent / f"{root.name}.repaired"


def repair(root: Path | str, to: Path | None = None, in_place: bool = False) -> RepairReport:
    """Copy every whole episode of a dataset into a new one and say what was lost.

    Args:
        root: the damaged dataset; never changed.
        to: the new dataset; beside the old one if left out.
        in_place: at the end, give the copy the name of the original, which is then called
            ``<name>.damaged``.

    Raises:
        DataError: no whole episode is found, a writer has the dataset open, the disk is full, or
            a folder to be made is there already.
    """
    root = Path(root)
    if root.name in ("", ".."):  # what is made beside it is called after it
        root = root.resolve()
    if not (root / "data").is_dir():
        raise DataError(f"{root}: not a LeRobot dataset, the folder data is missing")
    copy, damaged = to or repaired_path(root), root.parent / f"{root.name}.damaged"
    if in_place and damaged.exists():
        raise DataError(f"{damaged}: exists already; move it away first")
    with no_writer(root):
        report = RepairReport(copy, root)
        spec, recipe = _shared(root)
        pointers = _pointers(root)
        with Rewriter(copy, spec, recipe) as rewriter:
            for found in _find(root, spec, pointers, report.lost):
                try:
                    rewriter.add(found.columns, found.sidecar, found.videos)
                except DataError as error:
                    report.lost.append(f"an episode: {error}")
                    continue
                report.episodes += 1
                report.frames += len(found.columns["index"])
    if in_place:
        os.rename(root, damaged)
        os.rename(copy, root)
        report.copy, report.original = root, damaged
    return report


def _shared(root: Path) -> tuple[DatasetSpec, dict[str, Any]]:
    """Return spec and recipe, from wherever they can still be read."""
    try:
        stored = read_json(root / SIDECAR_PATH)
        return DatasetSpec.from_json(stored["spec"]), dict(stored["recipe"])
    except (DataError, KeyError, TypeError, ValueError):
        pass
    for path in _data_files(root):
        try:
            texts = read_rows(path, [SIDECAR_COLUMN])[SIDECAR_COLUMN].to_pylist()
            sidecar = decode(next(filter(None, texts), ""), str(path))
        except DataError:
            continue
        return sidecar.spec, sidecar.recipe
    raise DataError(f"{root}: no episode of it can be read; nothing can be repaired")


def _data_files(root: Path) -> list[Path]:
    named = (root / "data").glob("chunk-*/file-*.parquet")
    return sorted(p for p in named if p.parent.name[6:].isdigit() and p.stem[5:].isdigit())


def _pointers(root: Path) -> dict[int, dict[str, Any]]:
    """Return the rows of ``meta/episodes`` that can be read, by episode, without statistics."""
    found: dict[int, dict[str, Any]] = {}
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        try:
            table = read_parquet(path)
        except DataError:
            continue
        if "episode_index" in table.column_names:
            names = [n for n in table.column_names if not n.startswith("stats/")]
            for row in table.select(names).to_pylist():
                found.setdefault(row["episode_index"], row)
    return found


def _find(
    root: Path, spec: DatasetSpec, pointers: dict[int, dict[str, Any]], lost: list[str]
) -> Iterator[_Found]:
    """Yield the whole episodes of a dataset; those that are not get a line in ``lost``."""
    for path in _data_files(root):
        for first_row, own, text in _candidates(path, spec, pointers, lost):
            where = f"{path}: episode {own['episode_index'][0]}"
            try:
                sidecar = _check(own, text, spec, where)
                videos = _locate(root, spec, path, own, first_row, pointers)
                _check_video(videos, sidecar)
            except DataError as error:
                known = str(error).startswith(str(path))
                lost.append(str(error) if known else f"{where}: {error}")
                continue
            yield _Found(own, text, videos)


def _candidates(
    path: Path, spec: DatasetSpec, pointers: dict[int, dict[str, Any]], lost: list[str]
) -> Iterator[tuple[int, dict[str, np.ndarray], str]]:
    """Yield first row in the file, columns and sidecar string of what may be an episode."""
    try:
        counts = group_rows(path)
    except DataError as error:
        lost.append(f"the footer of {error}")
        yield from _without_footer(path, spec, pointers, lost)
        return
    kinds = column_widths(spec)
    first = 0
    for number, count in enumerate(counts):
        try:
            table = read_rows(path, [*kinds, SIDECAR_COLUMN], number)
            columns = {n: column_values(table, n, *kind, path) for n, kind in kinds.items()}
            texts = table[SIDECAR_COLUMN].to_pylist()
        except DataError as error:
            lost.append(f"rows {first} to {first + count - 1} of {error}")
        else:
            edges = np.flatnonzero(np.diff(columns["episode_index"])) + 1
            for start, stop in zip([0, *edges], [*edges, len(texts)], strict=True):
                own = {name: values[start:stop] for name, values in columns.items()}
                yield first + int(start), own, texts[start]
        first += count


def _without_footer(
    path: Path, spec: DatasetSpec, pointers: dict[int, dict[str, Any]], lost: list[str]
) -> Iterator[tuple[int, dict[str, np.ndarray], str]]:
    """Yield what can be read from the pages themselves, given how long each episode is."""
    place = int(path.parent.name[6:]), int(path.stem[5:])
    expected = sorted(
        number
        for number, row in pointers.items()
        if (row.get("data/chunk_index"), row.get("data/file_index")) == place
    )
    lengths = [int(pointers[number].get("length") or 0) for number in expected]
    first = found = 0
    for columns, text in recover_rows(path, spec, lengths):
        yield first, columns, text
        first += lengths[found]
        found += 1
    lost += [
        f"{path}: episode {number}: the file ends before it does" for number in expected[found:]
    ]


def _check(own: dict[str, np.ndarray], text: str, spec: DatasetSpec, where: str) -> Sidecar:
    """Return the sidecar of an episode's rows; DataError unless they are all there and sound."""
    if not text:
        raise DataError(f"{where}: its first row is missing")
    sidecar = decode(text, where)
    steps = len(own["index"])
    if sidecar.steps != steps or not np.array_equal(own["frame_index"], np.arange(steps)):
        raise DataError(f"{where}: {steps} of {sidecar.steps} rows are left")
    if sidecar.spec.to_json() != spec.to_json():
        raise DataError(f"{where}: has another spec than the dataset")
    for name, values in own.items():
        if values.dtype.kind == "f" and not np.isfinite(as_table(values)).all():
            raise DataError(f"{where}: column {name} is not finite")
    try:
        build_episode(own, sidecar, {})
    except DataError as error:
        raise DataError(f"{where}: {error}") from None
    return sidecar


def _locate(
    root: Path,
    spec: DatasetSpec,
    path: Path,
    own: dict[str, np.ndarray],
    first_row: int,
    pointers: dict[int, dict[str, Any]],
) -> dict[str, tuple[Path, int]]:
    """Return camera to the video file and the first frame of an episode.

    Without its row of ``meta/episodes`` the layout of our writer is assumed: a video for each
    data file, frame for row.
    """
    row = pointers.get(int(own["episode_index"][0]))
    places: dict[str, tuple[Path, int]] = {}
    for camera in spec.cameras:
        key = video_key(camera)
        try:
            if row is None:
                raise KeyError
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            start = round(row[f"videos/{key}/from_timestamp"] * spec.fps)
        except (KeyError, TypeError, ValueError):
            chunk, file = int(path.parent.name[6:]), int(path.stem[5:])
            start = first_row
        target = VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file)
        if row is None and count_frames(root / target)[0] != sum(group_rows(path)):
            raise DataError(f"{target}: which of its frames belong to it is not known")
        places[camera] = (root / target, start)
    return places


def _check_video(videos: dict[str, tuple[Path, int]], sidecar: Sidecar) -> None:
    """Decode an episode's first and last frame; DataError if that fails."""
    for camera, (path, start) in videos.items():
        size = sidecar.spec.cameras[camera]
        for frame in (start, start + sidecar.steps - 1):
            for _ in decode_video(path, frame, frame + 1, sidecar.spec.fps, size):
                pass
