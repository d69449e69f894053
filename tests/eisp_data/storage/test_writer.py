"""The writer: round trips, refusals, and what a kill or a full disk leaves behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from storage_samples import assert_same, random_episode, spec_of

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage import files, meta, writer
from eisp_data.storage.lerobot import DatasetWriter, read_episodes, read_recipe, read_spec
from eisp_data.storage.merge import merge
from eisp_data.storage.repair import repair
from eisp_data.storage.schema import column_widths
from eisp_data.storage.validate import validate


def test_every_array_comes_back_to_the_last_bit(make_dataset):
    root, episodes = make_dataset()
    for ours, theirs in zip(episodes, read_episodes(root), strict=True):
        assert_same(ours, theirs)
    assert read_spec(root) == spec_of()
    assert read_recipe(root) == {"policy": "script", "seed": 0}


@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    dims=st.tuples(*[st.integers(1, 3)] * 3, st.integers(0, 2)),
    steps=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    info=st.dictionaries(
        st.text(),
        st.text() | st.integers() | st.booleans() | st.floats(allow_nan=False),
        max_size=3,
    ),
)
def test_any_shape_and_any_info_survive_the_round_trip(tmp_path_factory, dims, steps, info):
    observation_dim, goal_dim, action_dim, sim_state_dim = dims
    spec = spec_of(
        observation_dim=observation_dim,
        proprio_dim=1,
        goal_dim=goal_dim,
        action_dim=action_dim,
        sim_state_dim=sim_state_dim,
    )
    episodes = []
    for seed, length in enumerate(steps):
        drawn = random_episode(spec, length, seed)
        episodes.append(Episode(**{**vars(drawn), "info": info}))
    root = tmp_path_factory.mktemp("any") / "dataset"
    with DatasetWriter(root, spec, {}) as writer:
        writer.write(episodes)
    for ours, theirs in zip(episodes, read_episodes(root), strict=True):
        assert_same(ours, theirs)


def test_extra_columns_are_stored_beside_the_rows(tmp_path):
    spec = spec_of(extras={"age.joints": 2})
    age = np.arange(12, dtype=np.float32).reshape(6, 2)
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write([random_episode(spec, 6, 0)], extras=[{"age.joints": age}])
    table = pq.read_table(tmp_path / "d/data/chunk-000/file-000.parquet")
    assert np.array_equal(np.stack(table["age.joints"].to_numpy()), age)


@pytest.mark.parametrize(
    "name", [*column_widths(spec_of()), "eisp.episode", "observation.images.top"]
)
def test_an_extra_column_takes_the_place_of_no_other(name):
    with pytest.raises(DataError, match=f"{name!r} cannot name an extra column"):
        spec_of(extras={name: 1}, sim_state_dim=0)


def test_video_has_one_frame_per_row_and_the_last_image_is_kept(make_dataset):
    root, episodes = make_dataset(cameras=True)
    for ours, theirs in zip(episodes, read_episodes(root, images=True), strict=True):
        difference = ours.images["top"].astype(int) - theirs.images["top"]
        assert theirs.images["top"].shape == ours.images["top"].shape
        assert np.abs(difference).mean() < 4


def test_bad_input_writes_nothing(tmp_path):
    spec = spec_of()
    good = random_episode(spec, 4, 0)
    bad = random_episode(spec_of(goal_dim=2), 4, 1)
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        with pytest.raises(DataError, match=r"episode 1 of the batch: achieved_goal: .*3.*got 2"):
            writer.write([good, bad])
        assert writer.num_episodes == 0
    assert not (tmp_path / "d/meta").exists() and not (tmp_path / "d/data").exists()


def test_an_info_value_that_json_cannot_hold_is_refused(tmp_path):
    spec = spec_of()
    episode = Episode(**{**vars(random_episode(spec, 4, 0)), "info": {"arm": [1, 2]}})
    with DatasetWriter(tmp_path / "d", spec, {}) as writer, pytest.raises(DataError, match="'arm'"):
        writer.write([episode])


def test_resume_goes_on_after_the_last_batch(make_dataset):
    root, episodes = make_dataset()
    more = [random_episode(spec_of(), 7, 50), random_episode(spec_of(), 3, 51)]
    with DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True) as writer:
        assert writer.num_episodes == 5
        writer.write(more)
    for ours, theirs in zip([*episodes, *more], read_episodes(root), strict=True):
        assert_same(ours, theirs)


@pytest.mark.parametrize("copy", [lambda root, to: merge([root], to), repair])
def test_what_was_merged_or_repaired_is_resumed_and_tidied_up(make_dataset, tmp_path, copy):
    root, episodes = make_dataset(cameras=True)
    copy(root, tmp_path / "copy")
    spec = spec_of(cameras=True)
    more = random_episode(spec, 7, 50)
    recipe = {"policy": "script", "seed": 0}
    with DatasetWriter(tmp_path / "copy", spec, recipe, resume=True) as writer:
        writer.write([more])
    tables = [path.name for path in (tmp_path / "copy/meta/episodes").glob("*/*")]
    assert tables == ["file-000.parquet"]
    for ours, theirs in zip([*episodes, more], read_episodes(tmp_path / "copy"), strict=True):
        assert_same(ours, theirs)
    assert all(check.passed for check in validate(tmp_path / "copy"))


def test_resume_refuses_another_spec_or_recipe_by_name(make_dataset):
    root, _ = make_dataset()
    recipe = {"policy": "script", "seed": 0}
    with pytest.raises(DataError, match="spec differs in 'fps': 25 there, 30 now"):
        DatasetWriter(root, spec_of(fps=30), recipe, resume=True)
    with pytest.raises(DataError, match="recipe differs in 'seed'"):
        DatasetWriter(root, spec_of(), {**recipe, "seed": 1}, resume=True)
    with pytest.raises(DataError, match="already holds a dataset"):
        DatasetWriter(root, spec_of(), recipe)


def test_a_second_writer_is_refused_in_this_process_and_from_another(tmp_path):
    code = (
        "import sys; sys.path.insert(0, sys.argv[2])\n"
        "from storage_samples import spec_of\n"
        "from eisp_data.storage.lerobot import DatasetWriter\n"
        "DatasetWriter(sys.argv[1], spec_of(), {}, resume=True)\n"
    )
    with DatasetWriter(tmp_path / "d", spec_of(), {}):
        with pytest.raises(DataError, match="another writer"):
            DatasetWriter(tmp_path / "d", spec_of(), {}, resume=True)
        here = str(Path(__file__).parent)
        other = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "d"), here], capture_output=True, text=True
        )
        assert other.returncode and "is writing this dataset" in other.stderr
    DatasetWriter(tmp_path / "d", spec_of(), {}).close()


def test_a_folder_with_other_things_in_it_is_refused(tmp_path):
    (tmp_path / "thesis.pdf").touch()
    with pytest.raises(DataError, match="not empty"):
        DatasetWriter(tmp_path, spec_of(), {})


def test_a_batch_counts_from_the_moment_its_episodes_file_is_there(make_dataset):
    """Killed between meta/episodes and info.json: the batch is whole, only the summary is old."""
    root, _ = make_dataset()
    info = json.loads((root / "meta/info.json").read_text())
    stats = (root / "meta/stats.json").read_text()
    old = {**info, "total_episodes": 2, "total_frames": 13}
    (root / "meta/info.json").write_text(json.dumps(old))
    (root / "meta/stats.json").unlink()
    assert len(list(read_episodes(root))) == 5
    DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True).close()
    assert json.loads((root / "meta/info.json").read_text()) == info
    for name, column in json.loads(stats).items():
        again = json.loads((root / "meta/stats.json").read_text())[name]
        for stat, values in column.items():
            assert np.allclose(values, again[stat]), (name, stat)


def contents(root):
    """Return the bytes of every file of a dataset."""
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def refuse_to_resume(root, match):
    """Fail unless resuming is refused and leaves every file as it is."""
    before = contents(root)
    with pytest.raises(DataError, match=match) as caught:
        DatasetWriter(root, spec_of(cameras=True), {"policy": "script", "seed": 0}, resume=True)
    assert "\n" not in str(caught.value) and contents(root) == before


def test_resume_removes_nothing_if_episodes_have_been_lost(make_dataset):
    """The summary is written last, so it never knows of more episodes than meta/episodes has."""
    root, episodes = make_dataset(cameras=True)
    table = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(table).slice(0, 2), table)
    refuse_to_resume(root, "info.json says 5 episodes, meta/episodes has 2; run eisp-data repair")
    for ours, theirs in zip(episodes, read_episodes(repair(root).copy), strict=True):
        assert_same(ours, theirs)


def test_resume_removes_nothing_if_there_is_more_than_an_interrupted_batch_leaves(make_dataset):
    root, _ = make_dataset(cameras=True)
    for number in (2, 3):
        orphan = root / f"data/chunk-000/file-00{number}.parquet"
        orphan.write_bytes((root / "data/chunk-000/file-001.parquet").read_bytes())
    refuse_to_resume(root, r"no episode for 2 files, data/chunk-000/file-002.parquet first, .*re")


def test_resume_removes_nothing_of_what_another_tool_wrote_anew(make_dataset):
    root, _ = make_dataset(cameras=True)
    table = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(table).drop_columns(["policy"]), table)
    (root / "data/chunk-000/file-002.parquet").touch()
    refuse_to_resume(root, "written anew by another tool")


@pytest.fixture
def disk(monkeypatch):
    """Return the list of what the writer does to the disk from now on: (what, path)."""
    done: list[tuple[str, Path]] = []
    replace, fsync, make, unlink = os.replace, files.sync, Path.mkdir, Path.unlink

    def log(what, act):
        def logged(path, *words, **options):
            done.append((what, Path(words[0] if what == "rename" else path)))
            return act(path, *words, **options)

        return logged

    monkeypatch.setattr(os, "replace", log("rename", replace))
    monkeypatch.setattr(Path, "mkdir", log("make", make))
    monkeypatch.setattr(Path, "unlink", log("unlink", unlink))
    for module in (files, meta, writer):
        monkeypatch.setattr(module, "sync", log("sync", fsync))
    return done


def test_a_cut_cable_keeps_no_episode_without_its_rows_and_frames(tmp_path, disk):
    """Every entry of a folder is on the disk before meta/episodes counts on it."""
    root = tmp_path / "new/d"
    with DatasetWriter(root, spec_of(cameras=True), {}) as opened:
        opened.write([random_episode(opened.spec, 6, 0)])
        said = disk.copy()
    committed = said.index(("rename", root / "meta/episodes/chunk-000/file-000.parquet"))
    entries = [
        (place, path)
        for place, (what, path) in enumerate(said[:committed])
        if what in ("make", "rename") and ".staging" not in path.parts
    ]
    assert {".json", ".parquet", ".mp4"} <= {path.suffix for _, path in entries}
    for place, path in entries:
        assert ("sync", path.parent) in said[place:committed], path
    stated = len(said) - said[::-1].index(("rename", root / "meta/info.json"))
    assert ("sync", root / "meta/episodes/chunk-000") in said[committed:stated]
    assert ("sync", root / "meta") in said[stated:]


def test_a_cut_cable_keeps_the_one_table_of_episodes_or_those_it_replaces(make_dataset, disk):
    root, _ = make_dataset()
    first, second = (root / f"meta/episodes/chunk-000/file-00{i}.parquet" for i in (0, 1))
    said = disk[disk.index(("rename", second)) :]
    folder = said.index(("sync", first.parent), said.index(("rename", first)))
    assert folder < said.index(("unlink", second))


def test_rows_without_an_episode_are_dropped_on_resume(make_dataset):
    """Killed between the rows and meta/episodes: nothing refers to the rows."""
    root, episodes = make_dataset(cameras=True)
    orphan = root / "data/chunk-000/file-002.parquet"
    orphan.write_bytes((root / "data/chunk-000/file-001.parquet").read_bytes())
    video = root / "videos/observation.images.top/chunk-000/file-002.mp4"
    video.write_bytes(b"")
    recipe = {"policy": "script", "seed": 0}
    DatasetWriter(root, spec_of(cameras=True), recipe, resume=True).close()
    assert not orphan.exists() and not video.exists()
    assert len(list(read_episodes(root))) == len(episodes)


def test_an_interrupted_compaction_repeats_no_episode(make_dataset):
    root, episodes = make_dataset()
    first = root / "meta/episodes/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(first).slice(2), first.with_name("file-001.parquet"))
    assert len(list(read_episodes(root))) == len(episodes)
    DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True).close()
    assert not first.with_name("file-001.parquet").exists()


def test_what_a_kill_left_of_a_summary_half_written_is_removed_on_resume(make_dataset):
    root, _ = make_dataset()
    for name in ("meta/.info.json.7.tmp", "meta/episodes/chunk-000/.file-000.parquet.7.tmp"):
        (root / name).write_bytes(b"PAR1")
    assert [check.name for check in validate(root) if not check.passed] == ["no stray files"]
    DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True).close()
    assert all(check.passed for check in validate(root))
    assert not list(root.rglob("*.tmp"))


def test_a_large_batch_is_cut_between_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr("eisp_data.storage.batch.PART_BYTES", 2000)
    spec = spec_of()
    episodes = [random_episode(spec, 8, seed) for seed in range(6)]
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write(episodes)
    assert len(list((tmp_path / "d/data").glob("*/*.parquet"))) > 1
    for ours, theirs in zip(episodes, read_episodes(tmp_path / "d"), strict=True):
        assert_same(ours, theirs)
