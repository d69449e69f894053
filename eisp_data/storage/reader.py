"""Episodes out of a dataset, whole and bit-exact, also after LeRobot's tools have edited it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage.episodes import EpisodeIndex, check_cameras, read_index
from eisp_data.storage.files import read_json
from eisp_data.storage.meta import SIDECAR_PATH
from eisp_data.storage.rows import as_table, column_values, read_rows
from eisp_data.storage.schema import SIDECAR_COLUMN, SIM_STATE_COLUMN, column_widths
from eisp_data.storage.sidecar import Sidecar, decode
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.video import decode_video


@dataclass(frozen=True)
class Block:
    """The rows of consecutive episodes, as far as they share a data file."""

    path: Path
    first_episode: int
    starts: np.ndarray
    """(E + 1,) int64: where each episode begins in the columns, and the end of the last."""
    columns: Mapping[str, np.ndarray]
    """Numeric columns, each (N,) or (N, D), the dataset's dtype."""
    sidecars: list[Sidecar]


def check_version(root: Path) -> dict[str, Any]:
    """Return ``info.json``; DataError unless it is a LeRobot v3 dataset."""
    if not (root / "meta/info.json").is_file():
        raise DataError(f"{root}: not a LeRobot dataset, meta/info.json is missing")
    info = read_json(root / "meta/info.json")
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str) or not version.startswith("v3."):
        raise DataError(f"{root}: dataset format {version!r}; only v3 can be read")
    if SIDECAR_COLUMN not in (info.get("features") or (SIDECAR_COLUMN,)):
        raise DataError(
            f"{root}: a LeRobot dataset that was not made here: it says neither what was achieved "
            f"nor what should be (no column {SIDECAR_COLUMN}), so nothing can be learned from it"
        )
    return info


def read_spec(root: Path | str) -> DatasetSpec:
    """Return the spec of a dataset."""
    return _shared(Path(root))[0]


def read_recipe(root: Path | str) -> dict[str, Any]:
    """Return how a dataset was made.

    Of a dataset that LeRobot merged from several, ``{"merged": [recipe, …]}``, each one once.
    """
    return _shared(Path(root))[1]


def _shared(root: Path) -> tuple[DatasetSpec, dict[str, Any]]:
    check_version(root)
    path = root / SIDECAR_PATH
    if path.exists():
        stored = read_json(path)
        try:
            return DatasetSpec.from_json(stored["spec"]), dict(stored["recipe"])
        except (KeyError, TypeError, ValueError):
            raise DataError(f"{path}: spec or recipe is missing") from None
    spec: DatasetSpec | None = None
    recipes: list[dict[str, Any]] = []
    for sidecar in read_sidecars(root):
        spec = spec or sidecar.spec
        recipes += [] if sidecar.recipe in recipes else [sidecar.recipe]
    if spec is None:
        raise DataError(f"{root}: holds no episodes")
    return spec, recipes[0] if len(recipes) == 1 else {"merged": recipes}


def read_sidecars(root: Path) -> Iterator[Sidecar]:
    """Yield the sidecar of every episode, without reading any other column."""
    index = read_index(root)
    for first, stop in runs(index):
        path = index.data_path(first)
        table = read_rows(path, [SIDECAR_COLUMN, "episode_index"])
        starts = _starts(table, path, index, first, stop)
        yield from _sidecars(table, path, starts, first)


def read_blocks(root: Path, spec: DatasetSpec, finite: bool = True) -> Iterator[Block]:
    """Yield the rows of a dataset file by file, every column checked for shape and NaN.

    Args:
        root: the dataset.
        spec: its own.
        finite: off, NaN is let through.

    Raises:
        DataError: a file is missing, cut or damaged, a column is missing, of the wrong type or
            not finite, or rows and ``meta/episodes`` disagree. Names file, column and episode.
    """
    index = read_index(root)
    kinds = column_widths(spec)
    for first, stop in runs(index):
        path = index.data_path(first)
        table = read_rows(path, [*kinds, SIDECAR_COLUMN])
        starts = _starts(table, path, index, first, stop)
        rows = slice(starts[0], starts[-1])
        columns = {
            name: column_values(table, name, dtype, width, path)[rows]
            for name, (dtype, width) in kinds.items()
        }
        sidecars = _sidecars(table, path, starts, first)
        for number, sidecar in enumerate(sidecars):
            if sidecar.spec.to_json() != spec.to_json():
                raise DataError(f"{path}: episode {first + number} has another spec")
        block = Block(path, first, starts - starts[0], columns, sidecars)
        if finite:
            check_finite(block)
        yield block


def read_episodes(root: Path | str, images: bool = False) -> Iterator[Episode]:
    """Yield the episodes of a dataset in order.

    Args:
        root: the dataset's folder.
        images: decode the videos too; off, ``Episode.images`` is empty.
    """
    root = Path(root)
    spec = read_spec(root)
    index = read_index(root)
    for block in read_blocks(root, spec):
        for offset, sidecar in enumerate(block.sidecars):
            rows = slice(block.starts[offset], block.starts[offset + 1])
            number = block.first_episode + offset
            frames = _images(index, number, sidecar, spec) if images else {}
            try:
                yield build_episode({n: v[rows] for n, v in block.columns.items()}, sidecar, frames)
            except DataError as error:
                raise DataError(f"{block.path}: episode {number}: {error}") from None


def build_episode(
    columns: Mapping[str, np.ndarray], sidecar: Sidecar, images: Mapping[str, np.ndarray]
) -> Episode:
    """Return the Episode of its rows, (T,) or (T, D) each, and its sidecar."""
    steps = len(columns["action"])
    goals = columns["observation.desired_goal"].reshape(steps, -1)
    if (goals != goals[0]).any():
        raise DataError("observation.desired_goal changes within the episode")

    def with_last(name: str, last: np.ndarray) -> np.ndarray:
        return np.concatenate([as_table(columns[name]), last[None]])

    observation = with_last("observation.state", sidecar.observation[: sidecar.spec.proprio_dim])
    if "observation.environment_state" in columns:
        rest = sidecar.observation[sidecar.spec.proprio_dim :]
        environment = with_last("observation.environment_state", rest)
        observation = np.concatenate([observation, environment], axis=1)
    states = columns.get(SIM_STATE_COLUMN, np.zeros((steps, 0)))
    return Episode(
        observation=observation,
        achieved_goal=with_last("observation.achieved_goal", sidecar.achieved_goal),
        desired_goal=goals[0].copy(),
        action=as_table(columns["action"]).copy(),
        reward=columns["next.reward"].copy(),
        done=columns["next.done"].copy(),
        truncated=columns["next.truncated"].copy(),
        success=np.concatenate([[sidecar.first_success], columns["next.success"]]),
        sim_state=np.concatenate([as_table(states), sidecar.sim_state[None]]),
        seed=sidecar.seed,
        info=sidecar.info,
        images=images,
    )


def _images(
    index: EpisodeIndex, number: int, sidecar: Sidecar, spec: DatasetSpec
) -> dict[str, np.ndarray]:
    check_cameras(index, spec)
    images = {}
    for camera, size in spec.cameras.items():
        start = round(float(index.video_start_s[camera][number]) * spec.fps)
        stop = start + int(index.length[number])
        frames = decode_video(index.video_path(number, camera), start, stop, spec.fps, size)
        images[camera] = np.stack([*frames, sidecar.image(camera)])
    return images


def runs(index: EpisodeIndex) -> Iterator[tuple[int, int]]:
    """Yield (first, stop) of the episodes that lie in one data file one after the other."""
    first = 0
    for episode in range(1, len(index) + 1):
        if episode == len(index) or (index.data_file[episode] != index.data_file[first]).any():
            yield first, episode
            first = episode


def _starts(table: pa.Table, path: Path, index: EpisodeIndex, first: int, stop: int) -> np.ndarray:
    """Return (E + 1,) row offsets of episodes ``first`` to ``stop - 1`` in a file's table."""
    numbers = column_values(table, "episode_index", "int64", 1, path)
    begins = np.searchsorted(numbers, np.arange(first, stop + 1))
    lengths = np.diff(begins)
    wrong = np.flatnonzero(lengths != index.length[first:stop])
    if len(wrong) or (np.diff(numbers) < 0).any():
        episode = first + (int(wrong[0]) if len(wrong) else 0)
        found = int((numbers == episode).sum())
        raise DataError(
            f"{path}: episode {episode}: {found} rows in order; meta/episodes says "
            f"{index.length[episode]}"
        )
    return begins


def _sidecars(table: pa.Table, path: Path, starts: np.ndarray, first: int) -> list[Sidecar]:
    column = table[SIDECAR_COLUMN]
    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        raise DataError(f"{path}: column {SIDECAR_COLUMN} does not hold text")
    return [
        decode(column[int(row)].as_py() or "", f"{path}: episode {first + number}")
        for number, row in enumerate(starts[:-1])
    ]


def check_finite(block: Block) -> None:
    """Raise DataError, naming file, column, episode and row, if a number is not finite."""
    for name, values in block.columns.items():
        if values.dtype.kind != "f" or np.isfinite(values).all():
            continue
        row = int(np.argwhere(~np.isfinite(as_table(values)))[0][0])
        offset = int(np.searchsorted(block.starts, row, side="right")) - 1
        raise DataError(
            f"{block.path}: column {name}: not finite in episode {block.first_episode + offset}, "
            f"row {row - int(block.starts[offset])}"
        )
