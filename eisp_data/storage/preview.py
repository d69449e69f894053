"""A still picture of a dataset that needs no simulator: frames, or the paths of its goals."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from eisp_data.storage.cache import load_arrays
from eisp_data.storage.episodes import check_cameras, read_index
from eisp_data.storage.reader import read_spec
from eisp_data.storage.video import decode_video

SIZE = (640, 480)
_COLOURS = ((214, 61, 56), (51, 140, 214), (242, 179, 38), (92, 176, 94))


def preview_png(root: Path, episodes: int = 6) -> bytes:
    """Return a PNG: the last frames of some episodes, or, without cameras, goals seen from above.

    Args:
        root: the dataset.
        episodes: how many, evenly spread.
    """
    spec, index = read_spec(root), read_index(root)
    check_cameras(index, spec)
    chosen = np.unique(np.linspace(0, len(index) - 1, min(episodes, len(index))).astype(int))
    if spec.cameras:
        camera = next(iter(spec.cameras))
        frames: list[np.ndarray] = []
        for number in chosen:
            last = round(float(index.video_start_s[camera][number]) * spec.fps)
            last += int(index.length[number]) - 1
            path, size = index.video_path(number, camera), spec.cameras[camera]
            frames += decode_video(path, last, last + 1, spec.fps, size)
        return _png(np.concatenate(frames, axis=1))
    return _paths(root, chosen)


def _paths(root: Path, chosen: np.ndarray) -> bytes:
    """Draw the way of every object of the goal, x up and y to the left, and its goal as a ring."""
    from PIL import Image, ImageDraw

    arrays = load_arrays(root)
    goals = arrays.spec.goal_dim
    objects = goals // 3 if goals % 3 == 0 else 1
    width = goals // objects
    points = [
        arrays.achieved_goal[arrays.episode_start[e] : arrays.episode_start[e + 1]].reshape(
            -1, objects, width
        )[..., :2]
        for e in chosen
    ]
    targets = arrays.desired_goal[chosen].reshape(len(chosen), objects, width)[..., :2]
    every = np.concatenate([p.reshape(-1, p.shape[-1]) for p in [*points, targets]])
    low, span = every.min(axis=0), max(float(np.ptp(every, axis=0).max()), 1e-6)

    def pixel(place: np.ndarray) -> tuple[float, float]:
        right = place[1] - low[1] if len(place) > 1 else 0.0
        return (
            SIZE[0] / 2 + SIZE[1] * 0.42 * (1 - 2 * right / span),
            SIZE[1] * (0.92 - 0.84 * (place[0] - low[0]) / span),
        )

    image = Image.new("RGB", SIZE, (250, 249, 246))
    draw = ImageDraw.Draw(image)
    for way, goal in zip(points, targets, strict=True):
        for number in range(objects):
            colour = _COLOURS[number % len(_COLOURS)]
            draw.line([pixel(place) for place in way[:, number]], fill=colour, width=2)
            x, y = pixel(goal[number])
            draw.ellipse((x - 7, y - 7, x + 7, y + 7), outline=colour, width=3)
    return _png(np.asarray(image))


def _png(pixels: np.ndarray) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
