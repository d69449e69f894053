"""Where OpenGL does not work all else does, and what draws says so in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from ctypes.util import find_library
from types import SimpleNamespace

import mujoco
import pytest

from eisp_data.errors import ConfigError
from eisp_data.sim import offscreen
from eisp_data.sim.render import Renderer
from eisp_data.tasks.registry import get_task

CODE = """
from eisp_data.errors import ConfigError
from eisp_data.sim.render import Renderer
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import get_task
Worlds(get_task("stack"), 1, threads=1).reset([0])
print("simulated")
try: Renderer(get_task("stack"))
except ConfigError as error: print(error)
"""
OF_THE_MACHINE = {"DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"}


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}, "OpenGL by MUJOCO_GL='egl'"),
        ({"MUJOCO_GL": "", "__EGL_VENDOR_LIBRARY_FILENAMES": "/none"}, "by MUJOCO_GL='egl'"),
        ({"MUJOCO_GL": "glfw"}, "DISPLAY environment variable is missing"),
        ({"MUJOCO_GL": "disable"}, "OpenGL by MUJOCO_GL='disable'"),
        ({"MUJOCO_GL": "magic"}, "OpenGL by MUJOCO_GL='magic'"),
        pytest.param(
            {"MUJOCO_GL": "osmesa"},
            "OpenGL by MUJOCO_GL='osmesa'",
            marks=pytest.mark.skipif(find_library("OSMesa") is not None, reason="OSMesa is there"),
        ),
    ],
)
def test_what_draws_nothing_works_and_what_draws_is_one_line(
    broken: dict[str, str], said: str
) -> None:
    kept = {name: value for name, value in os.environ.items() if name not in OF_THE_MACHINE}
    done = subprocess.run(
        [sys.executable, "-c", CODE], env=kept | broken, capture_output=True, text=True
    )
    assert done.stderr == ""
    simulated, error = done.stdout.splitlines()
    assert simulated == "simulated"
    assert error.startswith("cannot render: ") and said in error


def test_an_opengl_that_mujoco_cannot_draw_with_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    freed = []

    def too_old(*_: object) -> None:
        raise mujoco.FatalError("OpenGL version 1.5 or higher required")

    context = SimpleNamespace(free=lambda: freed.append(True))
    monkeypatch.setattr(offscreen, "open_gl", lambda width, height: context)
    monkeypatch.setattr(mujoco, "MjrContext", too_old)
    with pytest.raises(ConfigError, match=r"cannot render: .*version 1.5 or higher"):
        Renderer(get_task("stack"))
    assert freed == [True]
