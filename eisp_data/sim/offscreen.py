"""Drawing without a window: an OpenGL context of mujoco's, for all that draws."""

from __future__ import annotations

import os
import sys
import warnings
from typing import Any

import mujoco
import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.storage.files import one_line


class Offscreen:
    """Draws scenes of one model, in pictures of one size."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open an OpenGL context; ConfigError if there is no OpenGL on this machine."""
        self._gl = open_gl(width, height)
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:  # an OpenGL that is too old
            self._gl.free()
            raise _cannot_render(error) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)

    def draw(self, scene: mujoco.MjvScene, image: np.ndarray) -> None:
        """Draw a scene into an (H, W, 3) uint8 RGB image, its lowest row first."""
        self._gl.make_current()
        mujoco.mjr_render(self._rectangle, scene, self._context)
        mujoco.mjr_readPixels(image, None, self._rectangle, self._context)

    def close(self) -> None:
        """Free the context; nothing can be drawn any more."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


def open_gl(width: int, height: int) -> Any:
    """Return an OpenGL context, made current: EGL on Linux, unless MUJOCO_GL says otherwise."""
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = "egl"
    try:
        # GLFW says in warnings only that there is no display.
        with warnings.catch_warnings(record=True, action="always") as said:
            kind = _kind_of_context()
            context = kind.__new__(kind)
            context._context = None  # its __del__ wants it, also where __init__ fails
            context.__init__(width, height)
            if not context._context:
                raise RuntimeError(said[0].message if said else "no window")
            context.make_current()
        return context
    except Exception as error:
        raise _cannot_render(error) from error


def _kind_of_context() -> Any:
    """Return mujoco's class of OpenGL contexts that MUJOCO_GL names."""
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    # Not by way of mujoco.GLContext: that was chosen when mujoco was first imported.
    if backend == "egl":
        from mujoco.egl import GLContext
    elif backend == "osmesa":
        from mujoco.osmesa import GLContext
    else:
        from mujoco import GLContext
    return GLContext


def _cannot_render(error: Exception) -> ConfigError:
    return ConfigError(
        f"cannot render: OpenGL by MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r} does not work "
        f"here ({type(error).__name__}: {one_line(error)}); install libegl1, or set MUJOCO_GL to "
        "one of egl, osmesa, glfw"
    )
