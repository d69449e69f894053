"""What must hold for the videos of a dataset whose ``meta/episodes`` knows every camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from eisp_data.errors import DataError
from eisp_data.storage.episodes import EpisodeIndex
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.video import count_frames, decode_video


def _video_files(index: EpisodeIndex, spec: DatasetSpec) -> Iterator[tuple[str, Path, int]]:
    """Yield camera, video file and how many frames its episodes need."""
    for camera in spec.cameras:
        needed: dict[Path, int] = {}
        for episode in range(len(index)):
            start = round(float(index.video_start_s[camera][episode]) * spec.fps)
            path = index.video_path(episode, camera)
            needed[path] = max(needed.get(path, 0), start + int(index.length[episode]))
        for path, frames in needed.items():
            yield camera, path, frames


def check_frame_counts(index: EpisodeIndex, spec: DatasetSpec) -> str:
    """Return what to say if every row has its frame, by the videos' packets; else DataError."""
    files = unused = 0
    for camera, path, needed in _video_files(index, spec):
        frames, size = count_frames(path)
        if frames < needed:
            raise DataError(f"{path}: {frames} frames for {needed} rows")
        if size != spec.cameras[camera]:
            raise DataError(f"{path}: {size} pixels; the spec says {spec.cameras[camera]}")
        files += 1
        unused += frames - needed
    beside = f", and {unused} that no row uses" if unused else ""
    return f"{files} file(s), a frame for every row{beside}"


def check_ends(index: EpisodeIndex, spec: DatasetSpec) -> str:
    """Decode the first and last frame of every episode; DataError if one cannot be."""
    for camera, size in spec.cameras.items():
        for episode in range(len(index)):
            start = round(float(index.video_start_s[camera][episode]) * spec.fps)
            path = index.video_path(episode, camera)
            for frame in (start, start + int(index.length[episode]) - 1):
                for _ in decode_video(path, frame, frame + 1, spec.fps, size):
                    pass
    return f"first and last frame of {len(index)} episodes decode; those between were not tried"
