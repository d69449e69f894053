"""Poses through frames in between: base to camera, camera to marker, gives base to marker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eisp_data.storage.mcap.collect import Source
from eisp_data.storage.mcap.mapping import StreamMap
from eisp_data.storage.mcap.resample import NANOSECONDS, make_series, resample

LONGEST_GAP_NS = NANOSECONDS
"""Transforms further apart are not interpolated, the earlier one is held."""


def edges(stream: StreamMap) -> list[StreamMap]:
    """Return the transforms from ``parent`` through ``via`` to ``frame``, one stream for each.

    A stream without ``via`` stands for itself.
    """
    if not stream.via:
        return [stream]
    frames = [stream.parent, *stream.via, stream.frame]
    return [
        replace(stream, parent=parent, frame=frame, via=(), fields=("position", "orientation"))
        for parent, frame in zip(frames[:-1], frames[1:], strict=True)
    ]


def chain(stream: StreamMap, found: list[Source]) -> Source:
    """Compose the sources of ``edges(stream)`` into that of ``stream``.

    A sample is taken when the last transform was: a marker seen at t is where the camera, at t,
    saw it. Transforms that are said once hold for all time.
    """
    last = found[-1]
    times = last.series.times_ns
    for edge in found[:-1]:
        if len(edge.series.times_ns) > 1:
            times = times[times >= edge.series.times_ns[0]]
    kept = np.isin(last.series.times_ns, times)
    pose = last.series.values[kept]
    for edge in reversed(found[:-1]):
        asked = np.maximum(times, edge.series.times_ns[0])
        outer, _ = resample(edge.series, asked, "interpolate", LONGEST_GAP_NS)
        pose = compose(outer, pose)
    columns: list[int] = []
    for name in stream.fields or ("position", "orientation"):
        columns += range(3) if name == "position" else range(3, 7)
    turns = tuple(at for at, column in enumerate(columns) if column == 3)
    left_out = {reason: n for edge in found for reason, n in edge.left_out.items()}
    if not kept.all():
        left_out["before the frames in between were known"] = int((~kept).sum())
    return replace(
        last,
        stream=stream,
        series=make_series(times, pose[:, columns], turns),
        names=tuple(last.names[column] for column in columns),
        log_times_ns=last.log_times_ns[kept],
        lost_before=last.lost_before[kept],
        left_out=left_out,
    )


def compose(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Return the poses (N, 7), position and quaternion wxyz, of ``inner`` seen from outside.

    ``outer`` is where the frame is in which ``inner`` was measured.
    """
    position = outer[:, :3] + rotate(outer[:, 3:], inner[:, :3])
    return np.concatenate([position, multiply(outer[:, 3:], inner[:, 3:])], axis=1)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products (N, 4) of quaternions wxyz."""
    real = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    imaginary = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([real, imaginary], axis=1)


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn vectors (N, 3) by unit quaternions (N, 4) wxyz."""
    twice = 2 * np.cross(quaternion[:, 1:], vector)
    return vector + quaternion[:, :1] * twice + np.cross(quaternion[:, 1:], twice)
