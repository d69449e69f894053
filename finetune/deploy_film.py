"""Films of a recorded session: what the camera saw, with subgoals and goals projected into it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from eisp_data.robots.pose import View
from eisp_data.sim.render import object_colours
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.storage.mcap import decode, pixels
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.tasks.base import Task
from finetune.deploy_trace import Trace
from finetune.video import write_video

_GOAL_RADIUS_M = 0.013
_FACE_ALPHA = 0.35
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_EDGES = [(a, b) for a in range(8) for b in range(a) if (_CORNERS[a] != _CORNERS[b]).sum() == 1]
_FPS, _SECOND_NS = 30, 1_000_000_000


def film(recording: Path, trace: Trace, camera: str, view: View, task: Task, to: Path) -> int:
    """Write one episode as MP4; return how many images it has.

    Args:
        recording: an MCAP file.
        trace: the episode.
        camera: whose images.
        view: the same camera, calibrated.
        task: whose colours to draw in.
        to: the film.
    """
    return write_video(to, _frames(recording, trace, camera, view, task), _FPS)


def _frames(
    recording: Path, trace: Trace, camera: str, view: View, task: Task
) -> Iterator[np.ndarray]:
    colours = [255 * colour for colour in object_colours(task)]
    decoder = decode.Decoder()
    shown, last = 0, None
    with McapLog(recording) as log:
        for entry in log.messages({f"/camera/{camera}/image"}):
            at = entry.message.publish_time_ns
            if not trace.start_ns <= at <= trace.end_ns:
                continue
            picture = decoder.decode(
                entry.channel, log.schema_of(entry.channel), entry.message.data
            )
            assert isinstance(picture, decode.Picture)
            image = pixels.rgb(picture)
            drawn = draw(image, view, trace.goal, trace.subgoal_at(at), colours)
            # Where images were lost the last one stays: a film lasts as long as the episode.
            due = 1 + round((at - trace.start_ns) * _FPS / _SECOND_NS)
            for _ in range(shown + 1, due):
                yield drawn if last is None else last
            if due > shown:
                yield drawn
            shown, last = max(due, shown), drawn


def draw(
    image: np.ndarray,
    view: View,
    goal: np.ndarray,
    subgoal: np.ndarray | None,
    colours: list[np.ndarray],
) -> np.ndarray:
    """Return the (H, W, 3) uint8 image with the goal as discs and the subgoal as cubes of glass."""
    import cv2

    image = image.copy()
    for place, colour in zip(goal.reshape(-1, 3), colours, strict=True):
        middle, side = view.project(np.array([place, place + [0.0, _GOAL_RADIUS_M, 0.0]]))
        radius = max(2, round(float(np.linalg.norm(side - middle))))
        centre = (round(float(middle[0])), round(float(middle[1])))
        cv2.circle(image, centre, radius, colour.tolist(), -1, cv2.LINE_AA)
        cv2.circle(image, centre, radius, (255, 255, 255), 1, cv2.LINE_AA)
    if subgoal is None:
        return image
    glass = image.copy()
    cubes = [
        np.round(view.project(place + BLOCK_SIZE_M / 2 * _CORNERS)).astype(np.int32)
        for place in subgoal.reshape(-1, 3)
    ]
    for cube, colour in zip(cubes, colours, strict=True):
        cv2.fillConvexPoly(glass, cv2.convexHull(cube), colour.tolist(), cv2.LINE_AA)
    image = cv2.addWeighted(glass, _FACE_ALPHA, image, 1 - _FACE_ALPHA, 0.0)
    for cube, colour in zip(cubes, colours, strict=True):
        for a, b in _EDGES:
            cv2.line(image, cube[a].tolist(), cube[b].tolist(), colour.tolist(), 1, cv2.LINE_AA)
    return image
