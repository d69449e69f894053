"""What is refused of a Hub: paths that climb out, pickled files, wrong checksums."""

from __future__ import annotations

import hashlib
from pathlib import Path, PurePosixPath
from typing import Any

from eisp_data.errors import DataError

PICKLED = (".pkl", ".pickle", ".pt", ".pth", ".bin", ".ckpt", ".joblib", ".dill", ".npy", ".npz")
"""Endings of files whose loading can run code."""


def refuse_path(path: str) -> None:
    """Raise DataError for a path that leaves the folder or names a pickled file."""
    parts = PurePosixPath(path).parts
    if (
        not parts
        or path.startswith("/")
        or ".." in parts
        or "\\" in path
        or ":" in parts[0]
        or "\0" in path
    ):
        raise DataError(f"path {path!r} climbs out of the folder; nothing was fetched")
    if PurePosixPath(path).suffix.lower() in PICKLED:
        raise DataError(f"file {path!r} may be pickled, and loading it can run code; refused")


def refuse_pickle(name: str, path: Path) -> None:
    """Raise DataError for a file that is pickled by its name or its first bytes."""
    refuse_path(name)
    with path.open("rb") as file:
        head = file.read(4)
    # A pickle of protocol 2 and up, or the zip in which PyTorch wraps one.
    if (len(head) >= 2 and head[0] == 0x80 and 2 <= head[1] <= 5) or head == b"PK\x03\x04":
        raise DataError(f"file {name!r} is pickled, and loading it can run code; refused")


def verify(path: Path, entry: Any) -> None:
    """Compare a file with the checksum of its entry: SHA-256 of LFS, git's SHA-1 of others."""
    refuse_pickle(entry.path, path)
    if entry.lfs:
        expected, digest = entry.lfs.sha256, hashlib.sha256()
    else:
        expected, digest = entry.blob_id, hashlib.sha1(b"blob %d\0" % path.stat().st_size)
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    if digest.hexdigest() != expected:
        raise DataError(f"file {entry.path!r} does not have the checksum that the Hub states")
