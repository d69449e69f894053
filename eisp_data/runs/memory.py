"""What becomes of memory that is freed."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of glibc's malloc.h; see mallopt(3)."""
_NEVER = 2**31 - 1
_LARGEST = 32 * 2**20
"""Bytes; glibc refuses a larger threshold."""


def keep_freed_memory() -> None:
    """Have the process keep what it frees for what it allocates next.

    glibc gives tensors of megabytes back to the system and gets them anew, page by page, in every
    update: of learning from images that is a fifth of the time. Other C libraries stay as they are.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST)
        mallopt(_TRIM_THRESHOLD, _NEVER)
