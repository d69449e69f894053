"""Recordings to test with: written by the real writer, on synthetic hardware times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from eisp_data.episode import Episode
from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.convert import ConvertConfig, ConvertReport, convert
from eisp_data.storage.mcap.writer import McapWriter, McapWriterConfig

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000
MS = 1_000_000
FAST = McapWriterConfig(fsync=False, chunk_bytes=8192)


def joint_angle(time_ns: int | np.ndarray) -> np.ndarray:
    """Return what joint ``a`` reads at a time: a straight line, so that interpolation is exact."""
    return np.asarray((np.asarray(time_ns) - START_NS) / 1e9)


def record_session(
    path: Path,
    episodes: int = 2,
    steps: int = 20,
    camera: bool = True,
    outcome: str = "success",
    config: McapWriterConfig = FAST,
) -> Path:
    """Record episodes of ``steps`` commands at 25 Hz, joints at 100 Hz, a camera at 20 Hz.

    Command k of an episode is (k / 100, -k / 100); an object is seen at 10 Hz; the camera's
    image k is filled with the value 10 k.
    """
    with McapWriter(path, config, {"task": "stack", "instruction": "Stack it."}) as writer:
        for episode in range(episodes):
            start = START_NS + episode * 10_000_000_000
            end = start + steps * PERIOD_NS
            writer.event("episode_start", start, policy="script")
            goal = [float(episode), 0.0, 0.1]
            writer.vector("/goal", goal, start, role="observation.desired_goal")
            for at in range(start - 50 * MS, end + 20 * MS, 10 * MS):
                _record_instant(writer, at, at - start, steps, camera)
            writer.event("episode_end", end, outcome=outcome)
    return path


def _record_instant(writer: McapWriter, at: int, since: int, steps: int, camera: bool) -> None:
    """Record what falls on one time, ``since`` nanoseconds after the start of the episode."""
    angle, end = float(joint_angle(at)), steps * PERIOD_NS
    writer.log("/joint_states", messages.joints(["a", "b"], [angle, 1.0], at), at)
    if (since + 50 * MS) % (100 * MS) == 0 and since < end:
        poses = {"block": ([angle, 0.0, 0.0], [1.0, 0, 0, 0])}
        writer.log("/objects", messages.transforms(poses, at), at)
    if camera and since >= -30 * MS and (since + 30 * MS) % (50 * MS) == 0 and since < end:
        grey = 10 * (since + 30 * MS) // (50 * MS)
        writer.image("/camera/top/image", np.full((32, 48, 3), grey, np.uint8), at)
    if since >= 0 and since % PERIOD_NS == 0 and since < end:
        k = since // PERIOD_NS
        writer.vector("/command", [k / 100, -k / 100], at, role="action")


def run(source: Path, target: Path, **changes: object) -> tuple[list[Episode], ConvertReport]:
    """Convert and return the episodes, without images."""
    report = convert(ConvertConfig(inputs=(source,), to=target, **changes))  # type: ignore[arg-type]
    return list(read_episodes(target)), report


def rows(root: Path) -> dict[str, np.ndarray]:
    """Return the columns of a dataset, all rows."""
    tables = [pq.read_table(path) for path in sorted(root.glob("data/*/*.parquet"))]
    names = [n for n in tables[0].column_names if not n.startswith("eisp.")]
    return {n: np.concatenate([np.array(t[n].to_pylist()) for t in tables]) for n in names}


def same(a: Episode, b: Episode) -> bool:
    """Return whether two episodes are equal in every array and in what is said of them."""
    arrays = ("observation", "achieved_goal", "desired_goal", "action", "reward", "success", "done")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in arrays) and a.info == b.info
