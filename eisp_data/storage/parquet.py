"""Reading parquet files that may be damaged: what is wrong with one is said in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from eisp_data.errors import DataError
from eisp_data.storage.files import one_line


def read_parquet(
    path: Path, columns: list[str] | None = None, row_group: int | None = None
) -> pa.Table:
    """Read a parquet file or one of its row groups; DataError if it is missing, cut or damaged."""
    with _readable(path):
        # One handle, one thread: a damaged page raises here instead of in a pool.
        # Our own files carry a checksum of each page; others are read without.
        file = pq.ParquetFile(path, page_checksum_verification=True)
        if row_group is not None:
            return file.read_row_group(row_group, columns=columns, use_threads=False)
        return file.read(columns=columns, use_threads=False)


def column_names(path: Path) -> list[str]:
    """Return the names of the columns; DataError if the file is missing or its footer damaged."""
    with _readable(path):
        return pq.read_schema(path).names


def group_rows(path: Path) -> list[int]:
    """Return how many rows each row group has; DataError as for ``column_names``."""
    with _readable(path):
        metadata = pq.read_metadata(path)
        return [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    # ValueError: the names of a damaged footer need not be UTF-8.
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        raise DataError(f"{path}: not a readable parquet file ({one_line(error)})") from None
