"""Rows out of a data file whose footer is gone: its pages are read one after the other.

A parquet file says only in its footer where its columns are. But each page begins with a header of
its own, our files hold one episode after the other with the columns in a known order, and
``meta/episodes`` says how many rows each has; that is enough. A checksum guards every page.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from eisp_data.errors import DataError
from eisp_data.storage.schema import SIDECAR_COLUMN, column_widths
from eisp_data.storage.spec import DatasetSpec

_MAGIC = b"PAR1"
_DATA, _DICTIONARY = 0, 2
_PLAIN, _BY_DICTIONARY = 0, (2, 8)
_LARGEST_PAGE = 1 << 27
"""Bytes; the writer's pages have 1 MB, so a header that says more is damaged."""
_DEEPEST = 8
"""Structs within structs of a page header; more is damage."""


def recover_rows(
    path: Path, spec: DatasetSpec, lengths: Sequence[int]
) -> Iterator[tuple[dict[str, np.ndarray], str]]:
    """Yield columns and sidecar of the episodes of a file, up to the first that is not whole.

    Args:
        path: a data file written by this package.
        spec: of its dataset.
        lengths: rows of its episodes, in order.
    """
    data = path.read_bytes()
    if data[:4] != _MAGIC:
        return
    kinds = {**column_widths(spec), SIDECAR_COLUMN: ("text", 1)}
    at = 4
    for rows in lengths:
        columns: dict[str, Any] = {}
        try:
            for name, (dtype, width) in kinds.items():
                columns[name], at = _column(data, at, dtype, rows, width)
        except (DataError, ValueError, IndexError, struct.error, pa.ArrowException, KeyError):
            return
        yield columns, columns.pop(SIDECAR_COLUMN)[0]


def _column(data: bytes, at: int, dtype: str, rows: int, width: int) -> tuple[Any, int]:
    """Return a column of one episode, (rows,) or (rows, width), and where the next one begins."""
    dictionary: Any = None
    parts: list[Any] = []
    count = 0
    while count < rows * width:
        header, start = _struct(data, at)
        size, whole = header[3], header[2]
        packed = data[start : start + size]
        if (
            not 0 <= whole <= _LARGEST_PAGE
            or len(packed) != size
            or zlib.crc32(packed) != header[4] & 0xFFFFFFFF
        ):
            raise DataError("a page is cut or damaged")
        at = start + size
        page = pa.Codec("snappy").decompress(packed, whole, asbytes=True) if size else b""
        if header[1] == _DICTIONARY:
            dictionary = _plain(page, dtype, header[7][1])
            continue
        if header[1] != _DATA:
            raise DataError("a page of an unknown kind")
        values = header[5][1]
        count += values
        # Levels of repetition (of lists only) and of definition, each after its length.
        offset = 0
        for _ in range(2 if width > 1 else 1):
            offset += 4 + struct.unpack_from("<I", page, offset)[0]
        if header[5][2] == _PLAIN:
            parts.append(_plain(page[offset:], dtype, values))
        elif header[5][2] in _BY_DICTIONARY and dictionary is not None:
            indices = _hybrid(page[offset + 1 :], page[offset], values)
            parts.append(
                [dictionary[i] for i in indices] if dtype == "text" else dictionary[indices]
            )
        else:
            raise DataError("a page in an unknown encoding")
    if count != rows * width:
        raise DataError("pages and rows disagree")
    if dtype == "text":
        return [text for part in parts for text in part], at
    merged = np.concatenate(parts)
    return (merged if width == 1 else merged.reshape(rows, width)), at


def _plain(page: bytes, dtype: str, count: int) -> Any:
    """Return ``count`` values as parquet stores them plainly."""
    if dtype == "text":
        texts, at = [], 0
        for _ in range(count):
            size = struct.unpack_from("<I", page, at)[0]
            texts.append(page[at + 4 : at + 4 + size].decode())
            at += 4 + size
        return texts
    if dtype == "bool":
        bits = np.unpackbits(np.frombuffer(page, np.uint8), bitorder="little")
        return bits[:count].astype(np.bool_)
    return np.frombuffer(page, dtype, count)


def _hybrid(data: bytes, width: int, count: int) -> np.ndarray:
    """Return ``count`` integers of ``width`` bits, in runs and in packs of eight."""
    out = np.zeros(count, np.int64)
    filled = at = 0
    while filled < count:
        header, at = _varint(data, at)
        if header & 1:
            size = (header >> 1) * width
            bits = np.unpackbits(np.frombuffer(data, np.uint8, size, at), bitorder="little")
            packed = bits.reshape(-1, width).astype(np.int64) @ (1 << np.arange(width))
            packed, at = packed[: count - filled], at + size
        else:
            size = (width + 7) // 8
            value = int.from_bytes(data[at : at + size], "little")
            packed, at = np.full(min(header >> 1, count - filled), value), at + size
        if not len(packed):
            raise DataError("an empty run")
        out[filled : filled + len(packed)] = packed
        filled += len(packed)
    return out


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise DataError("a number that does not end")


def _struct(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """Return the fields by number of a struct in Thrift's compact protocol, and where it ends."""
    if depth > _DEEPEST:
        raise DataError("structs nested too deeply")
    fields: dict[int, Any] = {}
    number = 0
    while data[at] != 0:
        step, kind = data[at] >> 4, data[at] & 15
        at += 1
        if step:
            number += step
        else:
            value, at = _varint(data, at)
            number = (value >> 1) ^ -(value & 1)
        if kind in (1, 2):
            fields[number] = kind == 1
        elif kind in (3, 4, 5, 6):
            value, at = (data[at], at + 1) if kind == 3 else _varint(data, at)
            fields[number] = (value >> 1) ^ -(value & 1)
        elif kind == 7:
            at += 8
        elif kind == 8:
            size, at = _varint(data, at)
            at += size
        elif kind == 12:
            fields[number], at = _struct(data, at, depth + 1)
        else:
            raise DataError("a field of an unexpected type")
    return fields, at + 1
