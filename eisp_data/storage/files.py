"""Files that are either whole or not there: atomic replacement, and the lock of a writer."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import platform
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from eisp_data.errors import ConfigError, DataError

_LOCKED_HERE: set[str] = set()


def one_line(error: BaseException) -> str:
    """Return what an error says as one line; some libraries say it in several."""
    return " ".join(str(error).split()) or type(error).__name__


def sync(path: Path) -> None:
    """Force a file or a folder's entries to the disk, so that a cut cable cannot undo them."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(path: Path) -> None:
    """Make a folder and the parents that it needs, each of them safe from a cut cable."""
    if path.is_dir():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync(path.parent)


def replace_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call ``write(temporary)`` and move the result over ``path``, which is never half-written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.touch()
        mode = temporary.stat().st_mode
        write(temporary)
        # safetensors lets only its owner read what it writes.
        temporary.chmod(mode)
        sync(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path, flag: str) -> None:
    """Make the folder of a file; raise ConfigError, naming the option, unless it can be written.

    To be called before the work whose result goes there.
    """
    new = not path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    except OSError as error:
        raise ConfigError(f"{flag}: cannot write {path}: {error.strerror}") from None
    if new:
        path.unlink()


def remove_temporaries(folder: Path) -> None:
    """Remove what ``replace_atomically`` leaves in and below a folder when it is killed.

    To be called by who alone writes there.
    """
    for path in folder.rglob(".*.tmp"):
        path.unlink(missing_ok=True)


def make_partial(to: Path) -> Path:
    """Make a hidden folder beside ``to``, to be filled and then renamed to it.

    What killed processes of this machine left there of ``to`` is removed.
    """
    ours = f".{to.name}.{platform.node()}."
    to.parent.mkdir(parents=True, exist_ok=True)
    for left in to.parent.iterdir():
        owner = left.name.removeprefix(ours).partition(".")[0]
        if left.name.startswith(ours) and owner.isdigit() and not _alive(int(owner)):
            shutil.rmtree(left, ignore_errors=True)
    partial = to.with_name(f"{ours}{os.getpid()}.{uuid.uuid4().hex[:8]}.partial")
    partial.mkdir()
    return partial


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def json_text(value: Any) -> str:
    """Return ``value`` as indented JSON; NaN and infinities, which JSON has not, become null."""

    def finite(part: Any) -> Any:
        if isinstance(part, Mapping):
            return {name: finite(item) for name, item in part.items()}
        if isinstance(part, list | tuple):
            return [finite(item) for item in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    return json.dumps(finite(value), indent=2, ensure_ascii=False, allow_nan=False)


def write_json(path: Path, value: Any) -> None:
    """Replace ``path`` by ``value`` as ``json_text``."""
    text = json_text(value) + "\n"
    replace_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_json(path: Path) -> Any:
    """Return the JSON of ``path``; DataError if it is missing or not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid JSON ({error})") from None


class WriterLock:
    """An exclusive claim on a folder that ends with the process, however it ends.

    A POSIX record lock, because children made by ``fork`` do not inherit it: a killed collector
    whose workers linger does not leave the dataset locked. It does not exclude a second writer
    in the same process, so those are kept in a set.
    """

    def __init__(self, folder: Path) -> None:
        self._key = str(folder.resolve())
        self._path = folder / ".writer.lock"
        if self._key in _LOCKED_HERE:
            raise DataError(f"{folder}: another writer of this process has this dataset open")
        self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The owner before may have removed the file between our open and our lock.
            if os.fstat(self._descriptor).st_nlink == 0:
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        except OSError as error:
            owner = os.read(self._descriptor, 32).decode(errors="replace").strip()
            os.close(self._descriptor)
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise DataError(
                    f"{folder}: cannot be locked against a second writer "
                    f"({error.strerror or error}); write to another filesystem"
                ) from None
            raise DataError(
                f"{folder}: process {owner or 'unknown'} is writing this dataset; "
                "wait for it to end or write elsewhere"
            ) from None
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, str(os.getpid()).encode())
        _LOCKED_HERE.add(self._key)

    def release(self) -> None:
        """Give the folder up; a second call does nothing."""
        if self._key in _LOCKED_HERE:
            _LOCKED_HERE.discard(self._key)
            self._path.unlink(missing_ok=True)
            os.close(self._descriptor)


@contextmanager
def no_writer(folder: Path) -> Iterator[None]:
    """Keep writers out of a folder meanwhile; DataError if one is at work.

    A folder that cannot be written needs no lock, and could not hold one.
    """
    lock = WriterLock(folder) if os.access(folder, os.W_OK) else None
    try:
        yield
    finally:
        if lock is not None:
            lock.release()
