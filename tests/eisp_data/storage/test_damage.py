"""Damaged datasets: validate finds it, repair keeps the rest, nothing ends in a traceback.

``EISP_MUTATIONS=2000`` in the environment runs the mutations in that number.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from storage_samples import assert_same, random_episode, spec_of

from eisp_data.errors import DataError, EispError
from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import DatasetWriter, read_episodes
from eisp_data.storage.merge import merge
from eisp_data.storage.preview import preview_png
from eisp_data.storage.repair import repair
from eisp_data.storage.validate import validate
from eisp_data.storage.video import decode_video, encode_video

MUTATIONS = int(os.environ.get("EISP_MUTATIONS", "40"))
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = "videos/observation.images.top"
MEMORY_BYTES = 700 * 2**20
"""How much more the process may ever take while it reads damaged files."""


def failed(root):
    return {check.name for check in validate(root) if not check.passed}


def test_a_sound_dataset_passes_every_check(make_dataset):
    for cameras in (False, True):
        root, _ = make_dataset(f"cameras-{cameras}", cameras=cameras)
        assert failed(root) == set()


def test_timestamps_of_an_episode_of_hours_are_as_good_as_float32_is(tmp_path):
    spec = spec_of(fps=3)
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write([random_episode(spec, 40_000, 0)])
    assert failed(tmp_path / "d") == set()
    path = tmp_path / "d/data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    late = table["timestamp"].to_numpy() + np.float32(0.01) * (np.arange(40_000) == 39_000)
    number = table.column_names.index("timestamp")
    pq.write_table(table.set_column(number, "timestamp", [late]), path)
    assert "timestamps" in failed(tmp_path / "d")


def test_repairing_a_sound_dataset_changes_no_episode(make_dataset, tmp_path):
    root, episodes = make_dataset(cameras=True)
    report = repair(root)
    assert (report.episodes, report.lost) == (5, [])
    for ours, theirs in zip(episodes, read_episodes(report.copy, images=True), strict=True):
        assert_same(ours, theirs)
    assert failed(report.copy) == set()


class TestEachKindOfDamage:
    def test_counts_that_disagree(self, make_dataset):
        root, _ = make_dataset()
        info = json.loads((root / "meta/info.json").read_text())
        info.update(total_episodes=4, total_frames=30)
        (root / "meta/info.json").write_text(json.dumps(info))
        assert failed(root) == {"episode count", "frame count"}
        assert failed(repair(root).copy) == set()

    def test_a_missing_footer_costs_no_episode_that_is_there(self, make_dataset):
        root, episodes = make_dataset(cameras=True)
        path = root / "data/chunk-000/file-001.parquet"
        data, footer = path.read_bytes(), int.from_bytes(path.read_bytes()[-8:-4], "little")
        path.write_bytes(data[: -8 - footer])
        assert "rows" in failed(root)
        report = repair(root)
        assert report.episodes == 5 and len(report.lost) == 1 and "the footer of" in report.lost[0]
        for ours, theirs in zip(episodes, read_episodes(report.copy, images=True), strict=True):
            assert_same(ours, theirs)

    def test_a_file_cut_in_an_episode_keeps_those_before(self, make_dataset):
        root, episodes = make_dataset()
        path = root / "data/chunk-000/file-001.parquet"
        group = pq.read_metadata(path).row_group(2)
        path.write_bytes(path.read_bytes()[: group.column(5).data_page_offset])
        report = repair(root)
        assert report.lost[1:] == [f"{path}: episode 4: the file ends before it does"]
        for ours, theirs in zip(episodes[:4], read_episodes(report.copy), strict=True):
            assert_same(ours, theirs)

    def test_long_episodes_of_many_pages_are_found_without_a_footer(self, tmp_path):
        spec = spec_of(sim_state_dim=60)
        episodes = [random_episode(spec, steps, steps) for steps in (3, 25_000, 40)]
        with DatasetWriter(tmp_path / "d", spec, {}) as writer:
            writer.write(episodes)
        path = tmp_path / "d/data/chunk-000/file-000.parquet"
        path.write_bytes(path.read_bytes()[:-8])
        report = repair(tmp_path / "d")
        for ours, theirs in zip(episodes, read_episodes(report.copy), strict=True):
            assert_same(ours, theirs)

    def test_a_half_written_last_episode(self, make_dataset):
        root, episodes = make_dataset()
        path = root / "data/chunk-000/file-001.parquet"
        table = pq.read_table(path)
        pq.write_table(table.slice(0, table.num_rows - 4), path)
        assert "rows" in failed(root)
        report = repair(root)
        assert report.lost == [f"{path}: episode 4: 6 of 10 rows are left"]
        for ours, theirs in zip(episodes[:4], read_episodes(report.copy), strict=True):
            assert_same(ours, theirs)

    def test_all_of_meta_gone(self, make_dataset):
        root, episodes = make_dataset(cameras=True)
        shutil.rmtree(root / "meta")
        report = repair(root)
        assert report.lost == []
        for ours, theirs in zip(episodes, read_episodes(report.copy, images=True), strict=True):
            assert_same(ours, theirs)

    def test_a_video_that_ends_early(self, make_dataset):
        root, _ = make_dataset(cameras=True)
        path = root / "videos/observation.images.top/chunk-000/file-001.mp4"
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert {"video frames", "video ends"} <= failed(root)
        report = repair(root)
        assert report.episodes == 2 and len(report.lost) == 3
        assert failed(report.copy) == set()

    def test_a_video_of_another_size(self, make_dataset):
        root, _ = make_dataset(cameras=True)
        path = root / "videos/observation.images.top/chunk-000/file-001.mp4"
        encode_video(path, np.zeros((27, 32, 64, 3), np.uint8), 25)
        assert {"video frames", "video ends"} <= failed(root)
        for attempt in (lambda: list(read_episodes(root, images=True)), lambda: preview_png(root)):
            with pytest.raises(DataError, match="is 32 x 64 pixels, not 48 x 48"):
                attempt()
        assert repair(root).episodes == 2

    def test_a_video_of_a_codec_that_nobody_knows(self, make_dataset):
        root, _ = make_dataset(cameras=True)
        path = root / "videos/observation.images.top/chunk-000/file-001.mp4"
        path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
        with pytest.raises(DataError, match="frame 0 cannot be decoded"):
            list(decode_video(path, 0, 1, 25, (48, 48)))
        assert {"video frames", "video ends"} <= failed(root)
        assert repair(root).episodes == 2

    def test_bits_of_one_row_group_cost_one_episode(self, make_dataset):
        root, _ = make_dataset()
        path = root / "data/chunk-000/file-001.parquet"
        column = pq.read_metadata(path).row_group(1).column(0)
        data = bytearray(path.read_bytes())
        offset = column.data_page_offset
        data[offset : offset + 20] = bytes(20)
        path.write_bytes(data)
        report = repair(root)
        assert report.episodes == 4 and len(report.lost) == 1

    @pytest.mark.parametrize(
        ("column", "check"),
        [("timestamp", "timestamps"), ("frame_index", "row numbers"), ("index", "row numbers")],
    )
    def test_rows_that_are_numbered_or_timed_wrong_fail_the_check_of_that_name(
        self, make_dataset, column, check
    ):
        root, _ = make_dataset()
        path = root / "data/chunk-000/file-001.parquet"
        table = pq.read_table(path)
        values = table[column].to_numpy().copy()
        values[3] += 1
        table = table.set_column(table.column_names.index(column), column, [values])
        pq.write_table(table, path)
        assert failed(root) == {check}

    @pytest.mark.parametrize(
        "start", [None, float("nan"), float("inf"), -0.04, 1e300, "text"], ids=str
    )
    def test_a_video_that_begins_at_no_time(self, make_dataset, start):
        root, _ = make_dataset(cameras=True)
        table = pq.read_table(root / EPISODES)
        name = f"{VIDEO}/from_timestamp"
        starts = [start] * 2 if isinstance(start, str) else [0.0, start]
        starts += starts[:1] * (table.num_rows - 2)
        number = table.column_names.index(name)
        pq.write_table(table.set_column(number, name, [starts]), root / EPISODES)
        assert failed(root) == {"episode table"}
        with pytest.raises(DataError, match=rf"file-000.parquet: column {name} "):
            list(read_episodes(root))

    def test_a_table_of_episodes_that_lacks_what_the_one_before_has(self, make_dataset):
        root, _ = make_dataset(cameras=True)
        table = pq.read_table(root / EPISODES)
        pq.write_table(table.slice(0, 2), root / EPISODES)
        rest = table.slice(2).drop_columns([f"{VIDEO}/from_timestamp"])
        pq.write_table(rest, (root / EPISODES).with_name("file-001.parquet"))
        assert failed(root) == {"episode table"}

    def test_a_camera_without_its_columns_in_the_table_of_episodes(self, make_dataset, tmp_path):
        root, _ = make_dataset(cameras=True)
        table = pq.read_table(root / EPISODES)
        lost = [name for name in table.column_names if name.startswith(VIDEO)]
        pq.write_table(table.drop_columns(lost), root / EPISODES)
        assert failed(root) == {"features", "no stray files"}
        recipe = {"policy": "script", "seed": 0}
        for attempt in (
            lambda: list(read_episodes(root, images=True)),
            lambda: preview_png(root),
            lambda: merge([root], tmp_path / "merged"),
            lambda: DatasetWriter(root, spec_of(cameras=True), recipe, resume=True),
        ):
            with pytest.raises(DataError, match="meta/episodes: no video of camera 'top'"):
                attempt()
        assert repair(root).episodes == 5

    def test_nan_costs_its_episode(self, make_dataset):
        root, _ = make_dataset()
        path = root / "data/chunk-000/file-000.parquet"
        table = pq.read_table(path)
        reward = table["next.reward"].to_numpy().copy()
        reward[0] = np.nan
        number = table.column_names.index("next.reward")
        pq.write_table(table.set_column(number, "next.reward", [reward]), path)
        assert failed(root) == {"no NaN"}
        report = repair(root)
        assert report.episodes == 4 and "next.reward is not finite" in report.lost[0]


def test_in_place_keeps_the_original_under_another_name(make_dataset):
    root, _ = make_dataset()
    (root / "meta/info.json").unlink()
    before = {p.relative_to(root): p.read_bytes() for p in root.rglob("*") if p.is_file()}
    report = repair(root, in_place=True)
    assert failed(root) == set()
    damaged = report.original
    assert damaged == root.with_name("dataset.damaged")
    after = {p.relative_to(damaged): p.read_bytes() for p in damaged.rglob("*") if p.is_file()}
    assert after == before


@pytest.mark.parametrize(("here", "path"), [("dataset", "."), ("dataset/data", "..")])
def test_a_dataset_is_repaired_from_within(make_dataset, monkeypatch, here, path):
    root, _ = make_dataset()
    monkeypatch.chdir(root.parent / here)
    report = repair(path)
    assert report.copy == root.with_name("dataset.repaired") and failed(report.copy) == set()
    assert repair(path, to=root.with_name("again"), in_place=True).copy == root
    assert root.with_name("dataset.damaged").is_dir()


def test_a_stuck_channel_and_a_late_action_are_pointed_out(tmp_path):
    spec = spec_of(action_dim=2)
    rng = np.random.default_rng(0)
    episodes = []
    for seed in range(4):
        drawn = random_episode(spec, 60, seed)
        action = rng.uniform(-1, 1, (60, 2)).astype(np.float32)
        observation = drawn.observation.copy()
        # The action moves the first component, 5 steps late.
        moves = np.concatenate([np.zeros((5, 2)), action[:-5]])[:, 0]
        observation[1:, 0] = observation[0, 0] + np.cumsum(moves)
        if seed == 2:
            observation[:, 3] = 0.5
        changed = {"observation": observation, "action": action}
        episodes.append(type(drawn)(**{**vars(drawn), **changed}))
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write(episodes)
    warned = {check.name: check.detail for check in validate(tmp_path / "d") if check.warning}
    assert warned["stuck channels"] == "observation.state[3] in episode 2"
    assert warned["action lag"].startswith("5 step(s), 200 ms")


def test_an_object_that_fell_off_the_table_is_pointed_out(tmp_path):
    spec = spec_of()
    episodes = [random_episode(spec, 30, seed) for seed in range(5)]
    episodes[3].achieved_goal[:, 2] -= 3000 * np.linspace(0, 1, 31, dtype=np.float32) ** 2
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write(episodes)
    warned = {check.name: check.detail for check in validate(tmp_path / "d") if check.warning}
    assert list(warned) == ["outliers"]
    assert "observation.achieved_goal[2] is -2" in warned["outliers"]
    assert "in episode 3, in most -" in warned["outliers"] and "more" not in warned["outliers"]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a file cut short, emptied, with bits flipped, a stretch zeroed or doubled."""
    if not data:
        return data
    kind = rng.integers(6)
    start = int(rng.integers(len(data)))
    length = int(min(len(data) - start, 1 + rng.integers(64)))
    if kind == 0:
        return data[:start]
    if kind == 1:
        return b""
    if kind == 2:
        return data[:start] + bytes(length) + data[start + length :]
    if kind == 3:
        return data[: start + length] + data[start:]
    if kind == 4:  # a number in text, a version, becomes another
        return data.replace(b"3", b"9", 1) if b"v3.0" in data else data[start:]
    changed = bytearray(data)
    for place in rng.integers(len(data), size=1 + rng.integers(8)):
        changed[place] ^= 1 << rng.integers(8)
    return bytes(changed)


def test_mutated_files_give_a_line_or_a_right_result(make_dataset, tmp_path):
    root, episodes = make_dataset(cameras=True, extras={"repeated.top": 1, "age_s.top": 1})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    by_seed = {episode.seed: episode for episode in episodes}
    files = sorted(p.relative_to(root) for p in root.rglob("*") if p.is_file())
    outcomes: Counter[str] = Counter()
    for number in range(MUTATIONS):
        rng = np.random.default_rng(number)
        copy, fixed = tmp_path / "mutated", tmp_path / "fixed"
        for folder in (copy, fixed):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(root, copy)
        chosen = copy / files[int(rng.integers(len(files)))]
        chosen.write_bytes(mutate(chosen.read_bytes(), rng))
        outcomes[_look(copy, fixed, by_seed)] += 1
    assert sum(outcomes.values()) == MUTATIONS
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"{MUTATIONS} mutations, {grown / 2**20:.0f} MiB more: {dict(outcomes)}")
    assert grown < MEMORY_BYTES


def _look(root: Path, fixed: Path, by_seed: dict) -> str:
    """Validate, read, cache and repair; whatever comes out must be an original episode or a line.

    Only what no checksum covers may differ: a flipped bit in the rows themselves.
    """
    words = []
    for name, action in (
        ("validate", lambda: "bad" if failed(root) else "good"),
        ("read", lambda: str(sum(1 for _ in read_episodes(root, images=True)))),
        ("cache", lambda: str(load_arrays(root).num_episodes)),
        ("repair", lambda: str(repair(root, fixed).episodes)),
    ):
        try:
            words.append(f"{name} {action()}")
        except EispError as error:
            assert "\n" not in str(error).strip(), (name, str(error))
            words.append(f"{name} refused")
    if fixed.exists():
        for episode in read_episodes(fixed):
            assert len(episode) == len(by_seed[episode.seed])
        assert failed(fixed) == set()
    return ", ".join(words)
