"""Recordings become LeRobot datasets: deterministic, resumable, with the age of every source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap_samples import FAST, MS, PERIOD_NS, START_NS, joint_angle, record_session

from eisp_data.episode import Episode
from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap import assemble, messages
from eisp_data.storage.mcap import convert as convert_module
from eisp_data.storage.mcap.convert import (
    ConvertConfig,
    ConvertReport,
    convert,
    suggested_mapping,
)
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.writer import McapWriter


def run(source: Path, target: Path, **changes: object) -> tuple[list[Episode], ConvertReport]:
    """Convert and return the episodes, without images."""
    report = convert(ConvertConfig(inputs=(source,), to=target, **changes))  # type: ignore[arg-type]
    return list(read_episodes(target)), report


def rows(root: Path) -> dict[str, np.ndarray]:
    """Return the columns of a dataset, all rows."""
    tables = [pq.read_table(path) for path in sorted(root.glob("data/*/*.parquet"))]
    names = [n for n in tables[0].column_names if not n.startswith("eisp.")]
    return {n: np.concatenate([np.array(t[n].to_pylist()) for t in tables]) for n in names}


def same(a: Episode, b: Episode) -> bool:
    """Return whether two episodes are equal in every array and in what is said of them."""
    arrays = ("observation", "achieved_goal", "desired_goal", "action", "reward", "success", "done")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in arrays) and a.info == b.info


def test_each_row_holds_what_the_recording_says_at_its_time(
    session_file: Path, tmp_path: Path
) -> None:
    report = convert(ConvertConfig(inputs=(session_file,), to=tmp_path / "d"))
    episodes = list(read_episodes(tmp_path / "d", images=True))
    assert (report.episodes, report.frames, report.lines) == (2, 40, [])
    for number, episode in enumerate(episodes):
        start = START_NS + number * 10_000_000_000
        ticks = start + PERIOD_NS * np.arange(21)
        assert len(episode) == 20
        np.testing.assert_allclose(episode.observation[:, 0], joint_angle(ticks), atol=1e-6)
        np.testing.assert_allclose(episode.action[:, 0], np.arange(20) / 100, atol=1e-7)
        # Objects are seen every 100 ms from 50 ms before the start on, and held.
        seen = start - 50 * MS + (ticks - start + 50 * MS) // (100 * MS) * 100 * MS
        np.testing.assert_allclose(episode.achieved_goal[:-1, 0], joint_angle(seen[:-1]), atol=1e-6)
        assert episode.desired_goal.tolist() == pytest.approx([number, 0.0, 0.1])
        assert episode.done.tolist() == [False] * 19 + [True] and not episode.truncated.any()
        image = (ticks - start + 30 * MS) // (50 * MS) * 10
        shown = episode.images["top"].mean(axis=(1, 2, 3))
        np.testing.assert_allclose(shown, image, atol=3)
        assert episode.info["policy"] == "script" and episode.info["source_episode"] == number


def test_the_age_of_every_source_is_in_each_row(session_file: Path, tmp_path: Path) -> None:
    run(session_file, tmp_path / "d")
    table = rows(tmp_path / "d")
    ticks_ms = np.arange(20) * 40
    first = slice(0, 20)
    ages = {name: values for name, values in table.items() if name.startswith("age_s.")}
    assert len(ages) == 6
    camera = table["age_s.camera.top.image"][first]
    np.testing.assert_allclose(camera, (ticks_ms + 30) % 50 / 1000, atol=1e-6)
    objects = table["age_s.objects.block.achieved_goal"][first]
    np.testing.assert_allclose(objects, (ticks_ms + 50) % 100 / 1000, atol=1e-6)
    np.testing.assert_allclose(table["age_s.goal.desired_goal"][first], ticks_ms / 1000, atol=1e-6)
    assert not table["age_s.command.action"].any()


def test_lerobot_opens_what_was_converted(session_file: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    run(session_file, tmp_path / "d")
    dataset = LeRobotDataset("local/d", root=tmp_path / "d")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 40, 25)
    item = dataset[25]
    assert item["action"][0] == pytest.approx(0.05)
    assert item["observation.images.top"].shape == (3, 32, 48)
    assert item["task"] == "Stack it."


def test_the_suggested_mapping_used_as_a_file_gives_the_same_rows(
    session_file: Path, tmp_path: Path
) -> None:
    text = suggested_mapping(ConvertConfig(inputs=(session_file,), to=tmp_path))
    (tmp_path / "mapping.yaml").write_text(text)
    run(session_file, tmp_path / "a")
    run(session_file, tmp_path / "b", mapping=tmp_path / "mapping.yaml")
    a, b = rows(tmp_path / "a"), rows(tmp_path / "b")
    assert a.keys() == b.keys() and all(np.array_equal(a[n], b[n]) for n in a)


def test_converting_twice_gives_the_same_rows(session_file: Path, tmp_path: Path) -> None:
    run(session_file, tmp_path / "a")
    run(session_file, tmp_path / "b")
    a, b = rows(tmp_path / "a"), rows(tmp_path / "b")
    assert a.keys() == b.keys() and all(np.array_equal(a[n], b[n]) for n in a)


def test_a_conversion_that_was_interrupted_goes_on_to_the_same_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = tuple(
        record_session(tmp_path / f"{i}.mcap", episodes=3, steps=5, camera=False) for i in range(2)
    )
    config = ConvertConfig(inputs=files, to=tmp_path / "whole")
    convert(config)
    monkeypatch.setattr(convert_module, "_BATCH_EPISODES", 1)

    class Stop(Exception):
        """Stands for whatever interrupts."""

    for stop_after in (1, 3, 5):

        def progress(done: int, at: int = stop_after) -> None:
            if done == at:
                raise Stop

        target = tmp_path / f"cut{stop_after}"
        with pytest.raises(Stop):
            convert(ConvertConfig(inputs=files, to=target), progress)
        assert len(list(read_episodes(target))) == stop_after
        with pytest.raises(DataError, match="resume"):
            convert(ConvertConfig(inputs=files, to=target))
        report = convert(ConvertConfig(inputs=files, to=target, resume=True))
        assert (report.written, report.episodes) == (6 - stop_after, 6)
        for a, b in zip(read_episodes(tmp_path / "whole"), read_episodes(target), strict=True):
            assert same(a, b)


def test_another_recording_or_rule_cannot_be_resumed_into_a_dataset(tmp_path: Path) -> None:
    one = record_session(tmp_path / "a.mcap", episodes=1, camera=False)
    other = record_session(tmp_path / "b.mcap", episodes=2, camera=False)
    run(one, tmp_path / "d")
    with pytest.raises(DataError, match="recipe differs in 'files'"):
        run(other, tmp_path / "d", resume=True)
    with pytest.raises(DataError, match="differs in 'clock'"):
        run(one, tmp_path / "d", resume=True, clock="log")


def record(path: Path, events: list[tuple[str, float, dict]], seconds: float = 2.0) -> Path:
    """Record joints and commands at 25 Hz for some seconds, with events at given seconds."""
    with McapWriter(path, FAST) as writer:
        for kind, at_s, details in events:
            writer.event(kind, START_NS + round(at_s * 1e9), **details)
        for k in range(int(seconds * 25) + 1):
            at = START_NS + k * PERIOD_NS
            angle = float(joint_angle(at))
            writer.log("/joint_states", messages.joints(["a"], [angle], at), at)
            writer.vector("/command", [k / 1000], at, role="action")
            writer.vector("/reached", [angle], at, role="observation.achieved_goal")
    return path


def test_episodes_are_cut_at_their_events(tmp_path: Path) -> None:
    source = record(
        tmp_path / "x.mcap",
        [
            ("episode_start", 0.2, {"operator": "ann"}),
            ("success", 0.5, {}),
            ("episode_end", 0.6, {"outcome": "success"}),
            ("episode_start", 0.8, {}),
            ("episode_end", 1.0, {"outcome": "discard"}),
            ("episode_start", 1.2, {}),
            ("episode_start", 1.4, {}),
            ("intervention_start", 1.48, {}),
            ("intervention_end", 1.56, {}),
        ],
    )
    episodes, report = run(source, tmp_path / "d")
    assert [len(e) for e in episodes] == [10, 5, 15]
    assert [e.info["outcome"] for e in episodes] == ["success", "", ""]
    assert [e.info["complete"] for e in episodes] == [True, False, False]
    assert [bool(e.done[-1]) for e in episodes] == [True, False, False]
    assert [bool(e.truncated[-1]) for e in episodes] == [False, True, True]
    assert episodes[0].info["operator"] == "ann" and episodes[0].info["success_mark"] is True
    assert episodes[0].observation[0, 0] == pytest.approx(0.2)
    assert any("discarded" in line for line in report.lines)
    held = rows(tmp_path / "d")["intervention"][-15:]
    assert np.flatnonzero(held).tolist() == [2, 3, 4]


def test_without_events_the_whole_recording_is_one_episode(tmp_path: Path) -> None:
    (episode,), _ = run(record(tmp_path / "x.mcap", []), tmp_path / "d")
    assert len(episode) == 50 and episode.info["goal"] == "last achieved"
    assert episode.success[-1] and episode.desired_goal.tolist() == [2.0]


def test_the_reward_is_zero_exactly_where_the_goal_error_is_within_epsilon(tmp_path: Path) -> None:
    (episode,), _ = run(record(tmp_path / "x.mcap", []), tmp_path / "d", epsilon_m=0.1)
    near = np.abs(episode.achieved_goal[:, 0] - 2.0) <= np.float32(0.1)
    assert np.array_equal(episode.success, near)
    assert np.array_equal(episode.reward, np.where(near[1:], 0.0, -1.0))


def test_a_goal_that_changes_starts_a_new_episode(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "y.mcap", FAST) as writer:
        for k in range(26):
            at = START_NS + k * PERIOD_NS
            writer.log("/joint_states", messages.joints(["a"], [k], at), at)
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
            if k in (0, 10):
                writer.vector("/goal", [k], at, role="observation.desired_goal")
    episodes, _ = run(tmp_path / "y.mcap", tmp_path / "d")
    assert [e.desired_goal.tolist() for e in episodes] == [[0.0], [10.0]]
    assert [len(e) for e in episodes] == [10, 15]
    # Both hold the observation at which the goal changed.
    assert episodes[0].observation[-1, 0] == episodes[1].observation[0, 0] == 10
    assert not episodes[0].done.any() and episodes[0].truncated[-1]


def test_a_goal_said_an_instant_after_the_first_command_is_that_of_the_first_row(
    tmp_path: Path,
) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        for episode in range(2):
            start = START_NS + episode * 2_000_000_000
            writer.event("episode_start", start)
            for k in range(10):
                at = start + k * PERIOD_NS
                writer.log("/joint_states", messages.joints(["a"], [k], at), at)
                writer.vector("/reached", [k], at, role="observation.achieved_goal")
                writer.vector("/command", [0.0], at, role="action")
                if k == 0:
                    late = at + 3 * MS
                    writer.vector("/goal", [episode], late, role="observation.desired_goal")
            writer.event("episode_end", at)
    episodes, _ = run(tmp_path / "x.mcap", tmp_path / "d")
    assert [(len(e), e.desired_goal.tolist()) for e in episodes] == [(9, [0.0]), (9, [1.0])]


def test_a_jittering_control_loop_loses_and_doubles_no_command(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        writer.event("episode_start", START_NS - MS)
        for k in range(101):
            seen = START_NS + k * PERIOD_NS + int(rng.uniform(-5, 5) * MS) * (k > 0)
            writer.vector("/state", [k], seen, role="observation.state")
            writer.vector("/reached", [k], seen, role="observation.achieved_goal")
            if k < 100:
                writer.vector("/command", [k / 100], seen + 6 * MS, role="action")
        writer.event("episode_end", seen + MS)
    (episode,), _ = run(tmp_path / "x.mcap", tmp_path / "d")
    np.testing.assert_allclose(episode.action[:, 0], np.arange(100) / 100, atol=1e-7)
    assert len(episode) == 100


def test_a_sensor_on_another_clock_is_named_with_the_way_out(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        for k in range(10):
            since_boot = k * PERIOD_NS
            writer.log("/joint_states", messages.joints(["a"], [k], since_boot), since_boot)
            at = START_NS + since_boot
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
    with pytest.raises(DataError, match=r"/joint_states begins -1\.7e\+09 s .* set clock: log"):
        run(tmp_path / "x.mcap", tmp_path / "d")


def test_a_dead_camera_is_reported_and_its_age_grows(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        writer.event("episode_start", START_NS)
        for k in range(51):
            at = START_NS + k * PERIOD_NS
            writer.log("/joint_states", messages.joints(["a"], [k], at), at)
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
            if k <= 20:
                writer.image("/camera/top", np.zeros((16, 16, 3), np.uint8), at)
        writer.event("episode_end", at)
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    assert len(episode) == 50 and episode.info["gaps"] == 1
    (line,) = report.lines
    assert "camera.top: no sample for 1.20 s, from 0.80 s on" in line
    assert rows(tmp_path / "d")["age_s.camera.top"][-1] == pytest.approx(29 * 0.04, abs=1e-5)


def test_rows_with_a_source_older_than_its_limit_are_left_out(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "y.mcap", FAST) as writer:
        for k in range(51):
            at = START_NS + k * PERIOD_NS
            writer.log("/joint_states", messages.joints(["a"], [k], at), at)
            writer.vector("/command", [0.0], at)
            if not 20 < k < 30:
                writer.vector("/reached", [k], at)
    (tmp_path / "m.yaml").write_text(
        "streams:\n"
        "  - {topic: /joint_states, to: observation.state}\n"
        "  - {topic: /reached, to: observation.achieved_goal, max_age_s: 0.1}\n"
        "  - {topic: /command, to: action}\n"
    )
    episodes, report = run(tmp_path / "y.mcap", tmp_path / "d", mapping=tmp_path / "m.yaml")
    assert [len(e) for e in episodes] == [22, 20]
    assert any("7 rows with a source too old" in line for line in report.lines)


def test_a_recording_that_was_cut_off_gives_the_episodes_that_are_left(
    session_file: Path, tmp_path: Path
) -> None:
    with McapLog(session_file) as log:
        last_chunk = log.layout.segments[-1].offset
    (tmp_path / "cut.mcap").write_bytes(session_file.read_bytes()[: last_chunk + 100])
    episodes, report = run(tmp_path / "cut.mcap", tmp_path / "d")
    whole, _ = run(session_file, tmp_path / "w")
    assert np.array_equal(episodes[0].observation, whole[0].observation)
    assert len(episodes) == 2 and not episodes[1].info["complete"]
    kept = len(episodes[1])
    assert 5 < kept < 20 and np.array_equal(episodes[1].action, whole[1].action[:kept])
    assert any("cut off" in line for line in report.lines)


def test_a_damaged_chunk_is_named_in_the_report(session_file: Path, tmp_path: Path) -> None:
    with McapLog(session_file) as log:
        chunk = log.layout.segments[2]
    data = bytearray(session_file.read_bytes())
    data[chunk.offset + 300] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    _, report = run(tmp_path / "bad.mcap", tmp_path / "d")
    assert any(f"bad.mcap: byte {chunk.offset}" in line for line in report.lines)


def test_samples_that_are_not_finite_count_as_missing(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        for k in range(26):
            at = START_NS + k * PERIOD_NS
            reading = float("nan") if k == 7 else float(k)
            writer.log("/joint_states", messages.joints(["a"], [reading], at), at)
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    assert episode.observation[7, 0] == pytest.approx(7.0)
    assert rows(tmp_path / "d")["age_s.joint_states.state"][7] == pytest.approx(0.04)
    assert any("1 samples not finite left out" in line for line in report.lines)


def test_subgoals_become_a_column_of_their_own(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        for k in range(26):
            at = START_NS + k * PERIOD_NS
            if k % 10 == 0:
                writer.vector("/subgoal", [k, -k], at, role="extra.subgoal")
            writer.log("/joint_states", messages.joints(["a"], [k], at), at)
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
    run(tmp_path / "x.mcap", tmp_path / "d")
    subgoals = rows(tmp_path / "d")["subgoal"]
    assert subgoals[:, 0].tolist() == [k // 10 * 10 for k in range(25)]


def test_mistakes_are_one_line_and_leave_no_half_dataset(
    session_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "d"
    with pytest.raises(DataError, match="no such file"):
        run(tmp_path / "absent.mcap", target)
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match=r"no \.mcap file"):
        run(tmp_path / "folder", target)
    for changes, message in (
        ({"rate_hz": 0}, "1 to 1000"),
        ({"epsilon_m": float("nan")}, "above 0"),
        ({"clock": "sundial"}, "hardware, log"),
    ):
        with pytest.raises(ConfigError, match=message):
            run(session_file, target, **changes)
    mapping = tmp_path / "m.yaml"
    text = "streams:\n  - {topic: /joint_states, to: observation.state}\n"
    text += "  - {topic: /command, to: observation.achieved_goal}\n"
    for stream, message in (
        ("{topic: /commands, to: action}", "no channel /commands; it has /camera/top/image"),
        ("{topic: /camera/top/image, to: action}", "pictures cannot go to action"),
        (
            "{topic: /joint_states, to: observation.images.x}, {topic: /command, to: action}",
            "not a channel of images",
        ),
        ("{topic: /joint_states, to: action, fields: [effort]}", "carry no effort"),
        ("{topic: /joint_states, to: action, fields: [values]}", "choose from position, velocity"),
        ("{topic: /command, to: action, low: [0], high: [1]}", "2 components but 1 limits"),
        ("{topic: /joint_states, to: action, low: [9, 9], high: [10, 10]}", "outside \\[-1, 1\\]"),
        ("{topic: /objects, frame: ghost, to: action}", "/objects \\(ghost\\): no sample"),
    ):
        mapping.write_text(text + "".join(f"  - {s}}}\n" for s in stream.rstrip("}").split("}, ")))
        with pytest.raises((DataError, ConfigError), match=message) as caught:
            run(session_file, target, mapping=mapping)
        assert "\n" not in str(caught.value)
    monkeypatch.setattr(assemble, "MAX_EPISODE_BYTES", 1000)
    with pytest.raises(DataError, match="GiB"):
        run(session_file, target)
    assert not target.exists() or not list(target.glob("[!.]*"))
