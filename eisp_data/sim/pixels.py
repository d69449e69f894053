"""Small camera images of simulated states, as a policy sees them; needs no display."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import cv2
import numpy as np

from eisp_data.sim.render import Renderer
from eisp_data.tasks.base import Task

NO_SHADOW = 0
SOFT_SHADOW = 512
"""Edge of the shadow map in pixels. Software OpenGL draws 6 frames/s with the scene's own 4096,
60 with 512 and 2,300 with none, so pictures for training (48 x 48) have none."""
_SMALL = 96
_OVERSAMPLE = 3
"""Small pictures are drawn three times as large and averaged: 9 samples a pixel, so that an edge
tells where it is to a fraction of a pixel. OpenGL's own 4 samples took 1.4 times as long."""


@contextmanager
def light(task: Task, shadow: int, samples: int) -> Iterator[None]:
    """Draw with another shadow map and so many samples a pixel within the ``with``."""
    quality = task.model.vis.quality
    before = quality.shadowsize, quality.offsamples
    quality.shadowsize, quality.offsamples = shadow, samples
    try:
        yield
    finally:
        quality.shadowsize, quality.offsamples = before


class Pixels:
    """One camera of a task's scene; the same state gives the same image, here or in a dataset."""

    def __init__(self, task: Task, camera: str, height: int, width: int) -> None:
        """Open an OpenGL context; ConfigError if there is none, or no such camera."""
        self.size = (height, width)
        self._factor = _OVERSAMPLE if max(self.size) <= _SMALL else 1
        with light(task, NO_SHADOW, samples=0 if self._factor > 1 else 4):
            self._renderer = Renderer(task, camera, width * self._factor, height * self._factor)

    def draw(self, states: np.ndarray) -> np.ndarray:
        """Return (N, H, W, 3) uint8 RGB images of (N, P) states."""
        images = np.empty((len(states), *self.size, 3), np.uint8)
        for image, state in zip(images, states, strict=True):
            drawn = self._renderer.render(state)
            if self._factor > 1:
                drawn = cv2.resize(drawn, self.size[::-1], interpolation=cv2.INTER_AREA)
            image[:] = drawn
        return images

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
