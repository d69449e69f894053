"""The reader: damaged data gives one line that names file, column and episode."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from storage_samples import random_episode, spec_of

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import DatasetWriter, read_episodes, read_spec
from eisp_data.storage.reader import read_sidecars

FILE = "data/chunk-000/file-001.parquet"


def change(root, name, edit):
    """Rewrite one column of the second data file: episodes 2 to 4, of 8, 9 and 10 rows."""
    table = pq.read_table(root / FILE)
    column = edit(table[name])
    table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, root / FILE)


@pytest.mark.parametrize("read", [lambda root: list(read_episodes(root)), load_arrays])
class TestBothReaders:
    def test_nan_is_named_by_file_column_episode_and_row(self, make_dataset, read):
        root, _ = make_dataset()

        def poison(column):
            values = np.stack(column.to_numpy()).copy()
            values[8 + 3, 0] = np.nan
            return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])

        change(root, "action", poison)
        with pytest.raises(DataError, match=r"file-001.parquet.*action.*episode 3, row 3"):
            read(root)

    def test_a_column_of_another_width_is_named(self, make_dataset, read):
        root, _ = make_dataset()
        change(root, "action", lambda c: pa.array([[0.0, 1.0]] * 27, pa.list_(pa.float32())))
        with pytest.raises(DataError, match=r"file-001.parquet.*action.*4 x float32.*2 x float32"):
            read(root)

    def test_a_missing_column_is_named(self, make_dataset, read):
        root, _ = make_dataset()
        table = pq.read_table(root / FILE).drop_columns(["next.truncated"])
        pq.write_table(table, root / FILE)
        with pytest.raises(DataError, match=r"file-001.parquet.*next.truncated.*missing"):
            read(root)

    def test_rows_that_are_missing_are_counted(self, make_dataset, read):
        root, _ = make_dataset()
        pq.write_table(pq.read_table(root / FILE).slice(0, 20), root / FILE)
        with pytest.raises(DataError, match=r"file-001.parquet: episode 4: 3 rows.*says 10"):
            read(root)

    def test_a_file_without_its_footer_is_named(self, make_dataset, read):
        root, _ = make_dataset()
        whole = (root / FILE).read_bytes()
        (root / FILE).write_bytes(whole[: len(whole) // 2])
        with pytest.raises(DataError, match=r"file-001.parquet: not a readable parquet file"):
            read(root)

    def test_a_broken_sidecar_is_named(self, make_dataset, read):
        root, _ = make_dataset()
        change(root, "eisp.episode", lambda c: pa.array(["{"] * 27))
        with pytest.raises(DataError, match=r"file-001.parquet: episode 2: the sidecar"):
            read(root)

    def test_another_format_version_is_refused(self, make_dataset, read):
        root, _ = make_dataset()
        info = json.loads((root / "meta/info.json").read_text())
        (root / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
        with pytest.raises(DataError, match=r"format 'v2.1'; only v3"):
            read(root)


def test_a_folder_that_is_no_dataset_is_refused(tmp_path):
    with pytest.raises(DataError, match="not a LeRobot dataset"):
        read_spec(tmp_path)


def test_a_dataset_of_lerobots_own_is_told_from_a_damaged_one(make_dataset):
    root, _ = make_dataset()
    info = json.loads((root / "meta/info.json").read_text())
    del info["features"]["eisp.episode"]
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="a LeRobot dataset that was not made here"):
        read_spec(root)


def test_episodes_of_one_dataset_share_what_is_said_of_it(tmp_path):
    """A recipe names every recording; a copy for each episode would grow with their square."""
    spec = spec_of()
    odd = {"spec": "{", "recipe": ', "spec": {', "noise": 0.5}
    episodes = [random_episode(spec, 4, 0), random_episode(spec, 4, 1)]
    episodes[1] = Episode(**{**vars(episodes[1]), "info": odd})
    recipe = {"files": [{"name": "a.mcap"}], "spec": {"recipe": {}}}
    with DatasetWriter(tmp_path / "d", spec, recipe) as writer:
        writer.write(episodes)
    first, second = read_sidecars(tmp_path / "d")
    assert first.recipe == recipe and second.recipe == recipe
    assert first.recipe["files"] is second.recipe["files"]
    assert (first.info, second.info) == (episodes[0].info, odd)
    assert first.spec == second.spec == spec
