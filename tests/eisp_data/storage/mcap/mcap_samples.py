"""Recordings to test with: written by the real writer, on synthetic hardware times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eisp_data.storage.mcap import messages
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
