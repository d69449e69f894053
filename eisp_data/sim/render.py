"""Pictures of recorded states, with goals and subgoals drawn in; needs no display."""

from __future__ import annotations

from collections import Counter
from typing import Self

import mujoco
import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.sim.offscreen import Offscreen
from eisp_data.sim.scene import BLOCK_SIZE_M
from eisp_data.tasks.base import Task

_GOAL_RADIUS_M = 0.013
_GOAL_ALPHA, _SUBGOAL_ALPHA = 0.75, 0.35
_MARKERS = 64
"""Room in the scene for goals and subgoals besides the bodies."""


class Renderer:
    """Draws one world of a task; goals are spheres and subgoals translucent cubes."""

    def __init__(
        self, task: Task, camera: str = "front", width: int = 480, height: int = 360
    ) -> None:
        """Open an OpenGL context.

        Args:
            task: whose worlds to draw.
            camera: a camera of the scene, ``front``, ``top`` or ``shoulder``.
            width: pixels.
            height: pixels.

        Raises:
            ConfigError: no such camera, or there is no OpenGL on this machine.
        """
        check_camera(task, camera)
        model = task.model
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        self._model, self._data = model, mujoco.MjData(model)
        self._colours = object_colours(task)
        self._offscreen = Offscreen(model, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + _MARKERS)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(camera).id
        self._shape = (height, width, 3)

    def render(
        self,
        state: np.ndarray,
        desired_goal: np.ndarray | None = None,
        subgoal: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw one state.

        Args:
            state: (P,) MuJoCo's full physics state.
            desired_goal: (G,) m; drawn as a sphere for each object, in its colour.
            subgoal: (G,) m; drawn as a translucent cube for each object.

        Returns:
            (H, W, 3) uint8 RGB.
        """
        model, data, scene = self._model, self._data, self._scene
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            model, data, mujoco.MjvOption(), None, self._camera, everything, scene
        )
        if desired_goal is not None:
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE
            self._mark(sphere, _GOAL_RADIUS_M, desired_goal, _GOAL_ALPHA)
        if subgoal is not None:
            # A little larger than a block, or the two would flicker where they coincide.
            half = 1.06 * BLOCK_SIZE_M / 2
            self._mark(mujoco.mjtGeom.mjGEOM_BOX, half, subgoal, _SUBGOAL_ALPHA)
        image = np.empty(self._shape, np.uint8)
        self._offscreen.draw(scene, image)
        return np.ascontiguousarray(image[::-1])

    def _mark(self, shape: mujoco.mjtGeom, size: float, places: np.ndarray, alpha: float) -> None:
        for place, colour in zip(np.reshape(places, (-1, 3)), self._colours, strict=True):
            geom = self._scene.geoms[self._scene.ngeom]
            rgba = np.append(colour, alpha).astype(np.float32)
            mujoco.mjv_initGeom(geom, shape, [size] * 3, place, np.eye(3).ravel(), rgba)
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR
            self._scene.ngeom += 1

    def close(self) -> None:
        """Free the OpenGL context; a closed renderer draws no more."""
        self._offscreen.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_camera(task: Task, camera: str) -> None:
    """Raise ConfigError unless the task's scene has the camera."""
    cameras = [task.model.camera(index).name for index in range(task.model.ncam)]
    if camera not in cameras:
        raise ConfigError(f"unknown camera {camera!r}; choose one of {', '.join(cameras)}")


def object_colours(task: Task) -> list[np.ndarray]:
    """Return the colour (3,), 0 to 1, of each object of the goal: that of the geom of its name."""
    model, seen, colours = task.model, Counter[str](), []
    names = {model.geom(index).name for index in range(model.ngeom)}
    for slot in task.objects:
        numbered = f"{slot.kind}{seen[slot.kind]}"
        seen[slot.kind] += 1
        geom = model.geom(numbered if numbered in names else slot.kind)
        rgba = geom.rgba if geom.matid[0] < 0 else model.mat_rgba[geom.matid[0]]
        colours.append(rgba[:3])
    return colours
