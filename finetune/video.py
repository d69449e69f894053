"""Films of episodes that every browser plays, with the current subgoal and the goal drawn in."""

from __future__ import annotations

import io
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage.files import replace_atomically

if TYPE_CHECKING:
    from eisp_data.sim.gym_worlds import AnyWorlds
    from finetune.rollout import SubgoalPolicy

SPEED = 2
"""Of a film, in times that of the robot: every second step is drawn."""
_HOLD_STEPS = 25
"""A film goes on for this long after the goal is reached for good."""
_OPTIONS = {"crf": "25", "preset": "medium"}
_CONTAINER = {"movflags": "+faststart"}
"""The index at the front, so that a browser can start before it has all."""


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int) -> int:
    """Write (H, W, 3) uint8 RGB frames as H.264 in MP4; return how many there were.

    An odd last row or column is left out: the colour format has one colour for two pixels.
    """
    import av

    count = 0
    with av.open(str(path), "w", format="mp4", options=_CONTAINER) as container:
        stream = None
        for count, image in enumerate(frames, start=1):
            height, width = (size // 2 * 2 for size in image.shape[:2])
            if stream is None:
                stream = container.add_stream("h264", rate=fps, options=_OPTIONS)
                stream.height, stream.width = height, width
                stream.pix_fmt = "yuv420p"
            even = np.ascontiguousarray(image[:height, :width])
            frame = av.VideoFrame.from_ndarray(even, format="rgb24")
            frame.pts, frame.time_base = count - 1, Fraction(1, fps)
            container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode())
    return count


def middle_frame(video: bytes) -> bytes:
    """Return the frame half way through an MP4 as a JPEG; DataError if it cannot be decoded."""
    import av

    try:
        with av.open(io.BytesIO(video), "r") as container:
            frames = list(container.decode(video=0))
        picture = io.BytesIO()
        frames[len(frames) // 2].to_image().save(picture, "JPEG", quality=85)
    except (OSError, ValueError, IndexError) as error:
        raise DataError(f"episode.mp4 cannot be decoded ({error})") from None
    return picture.getvalue()


class Film:
    """Remembers one world of an evaluation, as its ``watch``, and films it afterwards."""

    def __init__(self, world: int = 0) -> None:
        self._world = world
        self._steps: list[tuple[np.ndarray, np.ndarray]] = []
        self._solved: list[bool] = []
        self._goal = np.empty(0)
        self._task = ""

    def __call__(self, worlds: AnyWorlds, policy: SubgoalPolicy) -> None:
        """Remember the step that has just been taken."""
        i = self._world
        self._steps.append((worlds.state[i].copy(), policy.subgoal[i].copy()))
        self._solved.append(bool(worlds.success[i]))
        self._goal, self._task = worlds.desired_goal[i].copy(), worlds.name

    def write(self, path: Path) -> None:
        """Write the film as MP4; ConfigError if there is no OpenGL on this machine."""
        from eisp_data.sim.render import Renderer
        from eisp_data.sim.scene import CONTROL_HZ
        from eisp_data.tasks.registry import get_task

        steps = self._steps[: film_length(self._solved) : SPEED]
        with Renderer(get_task(self._task)) as renderer:
            frames = (renderer.render(state, self._goal, subgoal) for state, subgoal in steps)
            replace_atomically(path, lambda draft: write_video(draft, frames, CONTROL_HZ))


def film_length(solved: list[bool]) -> int:
    """Return how many steps to show: all, or to a little after the goal is reached for good."""
    failed = [step for step, success in enumerate(solved) if not success]
    last_failed = failed[-1] if failed else -1
    return min(len(solved), last_failed + 1 + _HOLD_STEPS)
