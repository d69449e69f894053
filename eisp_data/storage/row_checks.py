"""What must hold for the rows of a dataset, each check by name."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.episodes import EpisodeIndex
from eisp_data.storage.reader import Block, check_finite

TIMESTAMP_TOLERANCE_S = 1e-4
"""LeRobot's own."""


def _of_episodes(block: Block, index: EpisodeIndex) -> Iterator[tuple[str, int, slice]]:
    """Yield where it is, for errors, number and rows of each episode of a block."""
    for offset, start in enumerate(block.starts[:-1]):
        episode = block.first_episode + offset
        rows = slice(int(start), int(block.starts[offset + 1]))
        yield f"{block.path}: episode {episode}", episode, rows


def _finite(block: Block, index: EpisodeIndex) -> None:
    check_finite(block)


def _row_numbers(block: Block, index: EpisodeIndex) -> None:
    for where, episode, rows in _of_episodes(block, index):
        steps = np.arange(index.length[episode])
        if not np.array_equal(block.columns["frame_index"][rows], steps):
            raise DataError(f"{where}: frame_index does not count from 0 in steps of one")
        if not np.array_equal(block.columns["index"][rows], index.first_row[episode] + steps):
            raise DataError(f"{where}: index does not count from {index.first_row[episode]}")


def _timestamps(block: Block, index: EpisodeIndex) -> None:
    fps = block.sidecars[0].spec.fps
    for where, episode, rows in _of_episodes(block, index):
        expected = np.arange(index.length[episode]) / fps
        late = np.abs(block.columns["timestamp"][rows] - expected)
        # Beyond 2,048 s the neighbours of a float32 are further apart than the tolerance.
        beyond = late - np.spacing(expected.astype(np.float32))
        if not beyond.max() <= TIMESTAMP_TOLERANCE_S:
            row = int(beyond.argmax())
            raise DataError(f"{where}: timestamp of row {row} is {late[row]:.4g} s off")


def _sidecar_lengths(block: Block, index: EpisodeIndex) -> None:
    for sidecar, (where, _, rows) in zip(block.sidecars, _of_episodes(block, index), strict=True):
        if sidecar.steps != rows.stop - rows.start:
            raise DataError(
                f"{where}: {rows.stop - rows.start} rows; it was recorded with {sidecar.steps}"
            )


ROW_CHECKS: dict[str, tuple[Callable[[Block, EpisodeIndex], None], str]] = {
    "no NaN": (_finite, "every number is finite"),
    "row numbers": (_row_numbers, "frame_index and index count in steps of one"),
    "timestamps": (_timestamps, f"frame_index / rate within {TIMESTAMP_TOLERANCE_S} s"),
    "sidecars": (_sidecar_lengths, "every episode as long as it was recorded"),
}
"""Checks of the rows, block by block: name to (check, what to say if it passes)."""
