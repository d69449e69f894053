"""mujoco without OpenGL: it must not end what draws nothing. Light, and imports no mujoco."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType


def let_mujoco_do_without() -> None:
    """Let ``import mujoco`` succeed where OpenGL does not work; once in a process is enough."""
    sys.meta_path.insert(0, _OpenGLFinder())


class _OpenGLFinder(MetaPathFinder):
    """Finds mujoco's OpenGL, which it loads when it is imported itself, by way of ``_Loader``."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load that one module, None for all others."""
        if name != "mujoco.rendering.classic.gl_context":
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(name, spec.origin)
        return spec


class _Loader(SourceFileLoader):
    """Says ``ImportError`` where OpenGL does not work, with which mujoco goes on without it.

    PyOpenGL raises ``AttributeError`` without a library, and mujoco ``RuntimeError`` for a value of
    MUJOCO_GL that it does not know: those would end what draws nothing. What draws is told by
    ``eisp_data.sim.render``.
    """

    def exec_module(self, module: ModuleType) -> None:
        """Run the module's code."""
        try:
            super().exec_module(module)
        except Exception as error:
            raise ImportError(f"no OpenGL: {error}", name=self.name) from error
