"""Damaged parquet files are named in one line, whatever is asked of them."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eisp_data.errors import DataError
from eisp_data.storage.parquet import column_names, group_rows, read_parquet


@pytest.mark.parametrize("read", [read_parquet, column_names, group_rows])
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", "not a readable parquet file"),
        (lambda data: data[:-5], "not a readable parquet file"),
        # The names of columns are no longer UTF-8.
        (lambda data: data.replace(b"height", b"\xeceight"), "not a readable parquet file"),
        (None, "no such file"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(read, damage, message, tmp_path):
    path = tmp_path / "x.parquet"
    if damage:
        pq.write_table(pa.table({"height": [1.0, 2.0]}), path)
        path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(DataError, match=message) as error:
        read(path)
    assert "\n" not in str(error.value)
