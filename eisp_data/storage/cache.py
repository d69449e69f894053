"""The array cache: a dataset as memory-mapped arrays, for training that samples millions of rows.

It lives in ``<dataset>/.cache/eisp/<fingerprint>`` (in ``$EISP_CACHE`` if that is set, in the
user's cache folder if the dataset cannot be written to), is built beside its place and renamed
into it, and is built anew when the data changes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.episode import Scalar
from eisp_data.errors import DataError
from eisp_data.storage.episodes import read_index
from eisp_data.storage.files import make_partial
from eisp_data.storage.reader import Block, read_blocks, read_episodes, read_spec
from eisp_data.storage.schema import SIM_STATE_COLUMN
from eisp_data.storage.spec import DatasetSpec

LAYOUT = 1
"""Part of the fingerprint: raised when the arrays below change."""
FOOTER_BYTES = 4096


@dataclass(frozen=True)
class DatasetArrays:
    """All episodes one after the other; an episode of T actions has T + 1 rows.

    Worked example: episodes of 2 and 3 actions have rows 0-2 and 3-6, ``episode_start`` is
    ``[0, 3, 7]``, and ``action[2]`` and ``action[6]`` are zeros that nobody took.
    The arrays are read-only.
    """

    spec: DatasetSpec
    observation: np.ndarray
    """(R, S) float32."""
    achieved_goal: np.ndarray
    """(R, G) float32."""
    action: np.ndarray
    """(R, A) float32; zero in the last row of each episode."""
    reward: np.ndarray
    """(R,) float32, of the action in the same row; zero in the last row of each episode."""
    done: np.ndarray
    """(R,) bool, of the action in the same row; False in the last row of each episode."""
    truncated: np.ndarray
    """(R,) bool, of the action in the same row; False in the last row of each episode."""
    success: np.ndarray
    """(R,) bool, of the observation in the same row."""
    sim_state: np.ndarray
    """(R, P) float64."""
    desired_goal: np.ndarray
    """(E, G) float32."""
    episode_start: np.ndarray
    """(E + 1,) int64: episode e has rows ``episode_start[e]`` to ``episode_start[e + 1] - 1``."""
    seed: np.ndarray
    """(E,) int64."""
    info: list[dict[str, Scalar]]
    """Each episode's info."""
    places: np.ndarray | None = None
    """(R, P) float32, m: where the objects were, if the goals have been replaced by images."""

    @property
    def num_episodes(self) -> int:
        """Return E."""
        return len(self.seed)

    @property
    def num_steps(self) -> int:
        """Return the number of actions, R - E."""
        return len(self.reward) - len(self.seed)


ARRAYS = tuple(
    name for name in DatasetArrays.__dataclass_fields__ if name not in ("spec", "info", "places")
)


def fingerprint(root: Path | str) -> str:
    """Return a key that changes when data do: names, sizes, times and last bytes of all files.

    Reading the data itself would cost as much as building the cache; a footer holds the extremes
    of every column of every episode.
    """
    root = Path(root)
    digest = hashlib.sha256(f"layout {LAYOUT}".encode())
    folders = (
        "data/chunk-*/*.parquet",
        "meta/episodes/chunk-*/*.parquet",
        "videos/*/chunk-*/*.mp4",
    )
    for path in sorted(path for pattern in folders for path in root.glob(pattern)):
        status = path.stat()
        name = path.relative_to(root).as_posix()
        digest.update(f"{name} {status.st_size} {status.st_mtime_ns}\n".encode())
        with path.open("rb") as file:
            file.seek(max(0, status.st_size - FOOTER_BYTES))
            digest.update(file.read())
    return digest.hexdigest()[:32]


def load_arrays(root: Path | str) -> DatasetArrays:
    """Return a dataset's arrays, mapped from the cache, which is built first where needed.

    Raises:
        DataError: not a dataset, or the data is damaged; names file, column and episode.
    """
    root = Path(root)
    spec = read_spec(root)
    return cached(root, "", lambda f: _fill(root, spec, f), lambda f: _open(f, spec))


def load_images(root: Path | str, camera: str) -> np.ndarray:
    """Return the (R, H, W, 3) uint8 frames of a camera, mapped; its rows are those of the arrays.

    Raises:
        DataError: no such camera, or a video is damaged.
    """
    root = Path(root)
    spec = read_spec(root)
    if camera not in spec.cameras:
        known = ", ".join(spec.cameras) or "no cameras"
        raise DataError(f"{root}: no camera {camera!r}; there are {known}")
    return cached(
        root,
        f"-{camera}",
        lambda f: _fill_images(root, camera, f),
        lambda f: np.load(f / "images.npy", mmap_mode="r"),
    )


@contextmanager
def unchanged(root: Path) -> Iterator[None]:
    """Read several parts of a dataset that belong together; DataError if it changed meanwhile."""
    before = fingerprint(root)
    yield
    if fingerprint(root) != before:
        raise DataError(f"{root}: changed while it was read; wait for its writer to end")


def cached[T](root: Path, part: str, fill: Callable[[Path], None], open_: Callable[[Path], T]) -> T:
    """Return what ``open_`` reads from a part of a dataset's cache, filled first where needed.

    Args:
        root: the dataset.
        part: end of the name of the cache's folder.
        fill: writes the part into a folder.
        open_: reads it from one.
    """
    # Another process may drop the cache that this one is about to open, having seen newer data.
    for _ in range(3):
        key = fingerprint(root)
        folder = _folder(root) / f"{key}{part}"
        if not (folder / "done").exists():
            _build(fill, folder, key)
            if fingerprint(root) != key:  # a writer was at work: who knows what this is of
                shutil.rmtree(folder, ignore_errors=True)
                continue
        try:
            return open_(folder)
        except FileNotFoundError:
            continue
    raise DataError(f"{root}: changes faster than its cache can be built")


def _folder(root: Path) -> Path:
    """Return the folder of a dataset's caches, made if missing."""
    name = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eisp"
    chosen = os.environ.get("EISP_CACHE")
    candidates = [Path(chosen) / name] if chosen else [root / ".cache/eisp", home / name]
    for folder in candidates:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise DataError(
        f"no array cache can be written to {' or '.join(map(str, candidates))}; "
        "set EISP_CACHE to a folder that can"
    )


def _build(fill: Callable[[Path], None], folder: Path, key: str) -> None:
    temporary = make_partial(folder.parent / "building")
    try:
        fill(temporary)
        (temporary / "done").touch()
        try:
            os.rename(temporary, folder)
        except OSError:
            if not (folder / "done").exists():  # else another process was first: use its work
                raise
        for other in folder.parent.iterdir():
            if not other.name.startswith((".", key)):
                shutil.rmtree(other, ignore_errors=True)
    except OSError as error:
        raise DataError(f"{folder.parent}: cannot write the array cache ({error})") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _fill(root: Path, spec: DatasetSpec, folder: Path) -> None:
    index = read_index(root)
    if not len(index):
        raise DataError(f"{root}: holds no episodes")
    starts = np.concatenate([[0], np.cumsum(index.length + 1)])
    rows, episodes = int(starts[-1]), len(index)
    shapes: dict[str, tuple[tuple[int, ...], str]] = {
        "observation": ((rows, spec.observation_dim), "<f4"),
        "achieved_goal": ((rows, spec.goal_dim), "<f4"),
        "action": ((rows, spec.action_dim), "<f4"),
        "reward": ((rows,), "<f4"),
        "done": ((rows,), "|b1"),
        "truncated": ((rows,), "|b1"),
        "success": ((rows,), "|b1"),
        "sim_state": ((rows, spec.sim_state_dim), "<f8"),
        "desired_goal": ((episodes, spec.goal_dim), "<f4"),
        "seed": ((episodes,), "<i8"),
    }
    out = {
        name: _new_map(folder / f"{name}.npy", shape, dtype)
        if 0 not in shape
        else np.zeros(shape, dtype)
        for name, (shape, dtype) in shapes.items()
    }
    info: list[dict[str, Any]] = []
    for block in read_blocks(root, spec):
        _fill_block(out, block, starts)
        info += [sidecar.info for sidecar in block.sidecars]
    for name, array in out.items():
        if isinstance(array, np.memmap):
            array.flush()
        else:
            np.save(folder / f"{name}.npy", array)
    np.save(folder / "episode_start.npy", starts.astype(np.int64))
    (folder / "info.json").write_text(json.dumps(info))


def _new_map(path: Path, shape: tuple[int, ...], dtype: str) -> np.memmap:
    """Return a new file of zeros, mapped, with its room on the disk already taken.

    Without, the file is a hole, and filling it on a full disk kills the process with SIGBUS.
    """
    array = np.lib.format.open_memmap(path, "w+", dtype, shape)
    if hasattr(os, "posix_fallocate"):  # macOS has none
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return array


def _fill_block(out: dict[str, np.ndarray], block: Block, starts: np.ndarray) -> None:
    """Copy a block's rows to their places, each episode one row further than the one before."""
    first, count = block.first_episode, len(block.sidecars)
    lengths = np.diff(block.starts)
    # Row i of the block's episode k goes to starts[first] + i + k: one last row per episode.
    target = starts[first] + np.arange(block.starts[-1]) + np.repeat(np.arange(count), lengths)
    last = starts[first + 1 : first + count + 1] - 1
    columns, sidecars = block.columns, block.sidecars

    def wide(name: str) -> np.ndarray:
        return columns[name].reshape(len(target), -1)

    proprio = wide("observation.state")
    out["observation"][target, : proprio.shape[1]] = proprio
    if "observation.environment_state" in columns:
        out["observation"][target, proprio.shape[1] :] = wide("observation.environment_state")
    out["observation"][last] = [s.observation for s in sidecars]
    out["achieved_goal"][target] = wide("observation.achieved_goal")
    out["achieved_goal"][last] = [s.achieved_goal for s in sidecars]
    out["action"][target] = wide("action")
    for name in ("reward", "done", "truncated"):
        out[name][target] = columns[f"next.{name}"]
    out["success"][target + 1] = columns["next.success"]
    out["success"][starts[first : first + count]] = [s.first_success for s in sidecars]
    if SIM_STATE_COLUMN in columns:
        out["sim_state"][target] = wide(SIM_STATE_COLUMN)
        out["sim_state"][last] = [s.sim_state for s in sidecars]
    goals = wide("observation.desired_goal")[block.starts[:-1]]
    out["desired_goal"][first : first + count] = goals
    out["seed"][first : first + count] = [s.seed for s in sidecars]


def _fill_images(root: Path, camera: str, folder: Path) -> None:
    spec, index = read_spec(root), read_index(root)
    rows = int((index.length + 1).sum())
    shape = (rows, *spec.cameras[camera], 3)
    out = _new_map(folder / "images.npy", shape, "|u1")
    row = 0
    for episode in read_episodes(root, images=True):
        out[row : row + len(episode) + 1] = episode.images[camera]
        row += len(episode) + 1
    out.flush()


def _open(folder: Path, spec: DatasetSpec) -> DatasetArrays:
    arrays = {}
    for name in ARRAYS:
        path = folder / f"{name}.npy"
        array = np.load(path, mmap_mode="r" if path.stat().st_size > 4096 else None)
        array.flags.writeable = False
        arrays[name] = array
    info = json.loads((folder / "info.json").read_text())
    return DatasetArrays(spec=spec, info=info, **arrays)
