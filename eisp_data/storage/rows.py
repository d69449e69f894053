"""Rows of a data file: columns to parquet and back, checked for type and width."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from eisp_data.errors import DataError
from eisp_data.storage.files import one_line
from eisp_data.storage.parquet import column_names, read_parquet
from eisp_data.storage.schema import SIDECAR_COLUMN


def write_rows(
    path: Path, columns: Mapping[str, np.ndarray], sidecars: Sequence[str], lengths: Sequence[int]
) -> None:
    """Write a data file, closed with its footer.

    Args:
        path: the file.
        columns: numeric columns, (N,) or (N, D).
        sidecars: each episode's sidecar string, for its first row.
        lengths: rows of each episode, N in all.
    """
    arrays = {name: _arrow_column(values) for name, values in columns.items()}
    starts = np.cumsum([0, *lengths])
    texts = [""] * int(starts[-1])
    for start, text in zip(starts, sidecars, strict=False):
        texts[start] = text
    arrays[SIDECAR_COLUMN] = pa.array(texts)
    table = pa.table(arrays)
    # Measured values hardly repeat: a dictionary of them costs time and saves nothing.
    plain = [name for name, values in columns.items() if values.dtype.kind == "f"]
    with pq.ParquetWriter(
        path,
        table.schema,
        compression="snappy",
        write_page_checksum=True,
        use_dictionary=[n for n in table.column_names if n not in plain],
    ) as writer:
        # One row group per episode, as LeRobot's writer does, for reading at random.
        for start, stop in zip(starts[:-1], starts[1:], strict=True):
            writer.write_table(table.slice(start, stop - start))


def _arrow_column(values: np.ndarray) -> pa.Array:
    """Return (N,) or (N, D) values as LeRobot stores them: scalars, or lists of fixed size."""
    if values.ndim == 1:
        return pa.array(values)
    if values.shape[1] == 1:
        return pa.array(np.ascontiguousarray(values[:, 0]))
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def read_rows(path: Path, columns: list[str], row_group: int | None = None) -> pa.Table:
    """Return the named columns of a data file or of one of its row groups.

    Raises:
        DataError: the file or a column is not there, or is damaged.
    """
    names = column_names(path)
    missing = [name for name in columns if name not in names]
    if missing:
        raise DataError(f"{path}: column(s) {missing} are missing")
    return read_parquet(path, columns, row_group)


def column_values(table: pa.Table, name: str, dtype: str, width: int, path: Path) -> np.ndarray:
    """Return a column as (N,), or (N, width) if wider; DataError if it is anything else."""
    try:
        column = table[name].combine_chunks()
        if isinstance(column, pa.ChunkedArray):
            column = pa.concat_arrays(column.chunks)
        is_list = pa.types.is_list(column.type) or pa.types.is_large_list(column.type)
        if is_list or pa.types.is_fixed_size_list(column.type):
            column = column.flatten() if column.null_count == 0 else column
        if column.null_count:
            raise DataError(f"{path}: column {name} has empty cells")
        values = column.to_numpy(zero_copy_only=False)
    except pa.ArrowException as error:
        raise DataError(f"{path}: column {name} cannot be read ({one_line(error)})") from None
    if values.dtype != np.dtype(dtype) or values.size != table.num_rows * width:
        raise DataError(
            f"{path}: column {name}: expected {width} x {dtype} a row; "
            f"got {values.size / max(table.num_rows, 1):g} x {values.dtype}"
        )
    return values if width == 1 else values.reshape(-1, width)


def as_table(values: np.ndarray) -> np.ndarray:
    """Return (N,) or (N, D) as (N, D)."""
    return values.reshape(len(values), -1) if values.ndim == 1 else values
