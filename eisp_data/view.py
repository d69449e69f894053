"""An episode to look at: a storyboard, a film, a Rerun recording, with goal and subgoal."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from eisp_data.episode import Episode
from eisp_data.errors import ConfigError, DataError, EispError
from eisp_data.replay import chosen_episodes, task_of
from eisp_data.sim.pixels import SOFT_SHADOW, light
from eisp_data.sim.render import Renderer
from eisp_data.storage.lerobot import DatasetSpec, read_spec
from eisp_data.storage.preview import preview_png as plain_preview_png
from eisp_data.storage.video import encode_video

STORY_FRAMES = 6
MARGIN = 4
LEAST_HEIGHT = 240
"""Of a frame in the storyboard, pixels, about."""
SIZE = (480, 360)
"""Width and height of a drawn frame, pixels."""


def waypoints(steps: int, parts: int) -> np.ndarray:
    """Return (T + 1,) int64: for each observation, where the current subgoal was achieved.

    The trajectory is cut into ``parts`` equal parts; at t the subgoal is the end of the part that
    t is in. Worked example: 6 steps in 3 parts end at 2, 4 and 6, so
    ``waypoints(6, 3) == [2, 2, 4, 4, 6, 6, 6]``.
    """
    ends = np.round(np.arange(1, parts + 1) * steps / parts).astype(np.int64)
    return ends[np.minimum(np.searchsorted(ends, np.arange(steps + 1), side="right"), parts - 1)]


def draw(
    spec: DatasetSpec, episode: Episode, rows: Sequence[int] | None = None, camera: str = "front"
) -> np.ndarray:
    """Return (N, H, W, 3) uint8: states with the goal and the current subgoal drawn in.

    The subgoal is in hindsight: the next waypoint that the trajectory itself reaches.

    Args:
        spec: the dataset's.
        episode: with simulator states.
        rows: which of its T + 1 states; all if None.
        camera: of the scene.
    """
    task = task_of(spec.task, spec.sim_state_dim)
    target = waypoints(len(episode), task.paper.waypoints)
    chosen = range(len(episode) + 1) if rows is None else rows
    with light(task, SOFT_SHADOW, samples=4), Renderer(task, camera, *SIZE) as renderer:
        return np.stack(
            [
                renderer.render(
                    episode.sim_state[row],
                    episode.desired_goal,
                    episode.achieved_goal[target[row]],
                )
                for row in chosen
            ]
        )


def preview_png(root: Path) -> bytes:
    """Return a storyboard of the first episode; without a simulator, what the data itself show."""
    spec = read_spec(root)
    try:
        task_of(spec.task, spec.sim_state_dim)
        [(_, episode)] = chosen_episodes(root, [0])
        frames = draw(spec, episode, story_rows(len(episode) + 1))
    except EispError:  # a real robot, an unknown task, or no OpenGL here
        return plain_preview_png(root)
    buffer = io.BytesIO()
    Image.fromarray(storyboard(frames)[::2, ::2]).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def view(
    root: Path, to: Path, number: int = 0, camera: str = "", rerun: bool = False
) -> list[Path]:
    """Write ``episode-N.png``, ``episode-N.mp4`` and, if wished, ``episode-N.rrd`` into ``to``.

    Args:
        root: the dataset.
        to: folder for the files, made if missing.
        number: which episode.
        camera: of the scene if the dataset has simulator states, else one of its own; the first
            one there is if left out.
        rerun: write the Rerun recording too; needs the package ``rerun-sdk``.

    Returns:
        The files.
    """
    if rerun:
        _need_rerun()
    spec = read_spec(root)
    simulated = spec.sim_state_dim > 0
    name = camera or ("front" if simulated else next(iter(spec.cameras), ""))
    if not simulated and not spec.cameras:
        raise DataError(f"{root}: has neither simulator states nor camera images to draw")
    if not simulated and name not in spec.cameras:
        raise DataError(f"{root}: no camera {name!r}; there are {sorted(spec.cameras)}")
    [(_, episode)] = chosen_episodes(root, [number], images=not simulated)
    frames = draw(spec, episode, camera=name) if simulated else episode.images[name]
    to.mkdir(parents=True, exist_ok=True)
    stem = to / f"episode-{number}"
    written = [stem.with_suffix(".png"), stem.with_suffix(".mp4")]
    Image.fromarray(storyboard(frames)).save(written[0], optimize=True)
    encode_video(written[1], frames, spec.fps)
    if rerun:
        written.append(stem.with_suffix(".rrd"))
        _save_rerun(written[2], spec, episode, frames)
    return written


def story_rows(length: int) -> list[int]:
    """Return STORY_FRAMES rows of ``length``, evenly spaced, the first and the last among them."""
    return [int(row) for row in np.linspace(0, length - 1, STORY_FRAMES).round()]


def storyboard(frames: np.ndarray) -> np.ndarray:
    """Return some (T, H, W, 3) frames, evenly spaced, in two rows of one picture.

    Frames of a small camera are enlarged, each pixel to a square.
    """
    larger = max(1, LEAST_HEIGHT // frames.shape[1])
    chosen = frames[story_rows(len(frames))].repeat(larger, axis=1).repeat(larger, axis=2)
    _, height, width, _ = chosen.shape
    across = -(-STORY_FRAMES // 2)
    size = (2 * (height + MARGIN) - MARGIN, across * (width + MARGIN) - MARGIN, 3)
    page = np.full(size, 255, np.uint8)
    for place, frame in enumerate(chosen):
        top, left = place // across * (height + MARGIN), place % across * (width + MARGIN)
        page[top : top + height, left : left + width] = frame
    return page


def _need_rerun() -> None:
    try:
        import rerun  # noqa: F401
    except ImportError:
        raise ConfigError("--rerun needs the package rerun-sdk: pip install rerun-sdk") from None


def _save_rerun(path: Path, spec: DatasetSpec, episode: Episode, frames: np.ndarray) -> None:
    """Write images, goal, achieved goal, actions and reward along the time of the episode."""
    import rerun

    recording = rerun.RecordingStream("eisp")
    recording.save(path)
    objects = -1, 3 if spec.goal_dim % 3 == 0 else spec.goal_dim
    for row in range(len(episode) + 1):
        recording.set_time("time", duration=row / spec.fps)
        recording.log("camera", rerun.Image(frames[row]).compress(90))
        if objects[1] == 3:
            achieved = episode.achieved_goal[row].reshape(objects)
            desired = episode.desired_goal.reshape(objects)
            recording.log("achieved_goal", rerun.Points3D(achieved, radii=0.02))
            recording.log("desired_goal", rerun.Points3D(desired, radii=0.02))
        if row < len(episode):
            recording.log("action", rerun.Scalars(episode.action[row].astype(np.float64)))
            recording.log("reward", rerun.Scalars(float(episode.reward[row])))
    recording.flush()
