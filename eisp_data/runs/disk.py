"""A disk that is full, told in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

from eisp_data.errors import DataError
from eisp_data.storage.files import one_line


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Turn what a full disk raises within the ``with`` into a DataError of one line."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or one_line(error)
        raise DataError(f"{place} cannot be written: {reason}") from None
