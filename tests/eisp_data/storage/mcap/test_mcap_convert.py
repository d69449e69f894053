"""Recordings become LeRobot datasets: deterministic, resumable, with the age of every source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_samples import (
    FAST,
    MS,
    PERIOD_NS,
    START_NS,
    joint_angle,
    record_session,
    rows,
    run,
    same,
)

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.episodes import read_index
from eisp_data.storage.lerobot import read_episodes, read_recipe, read_spec
from eisp_data.storage.mcap import convert as convert_module
from eisp_data.storage.mcap import messages, timeline
from eisp_data.storage.mcap.convert import (
    ConvertConfig,
    convert,
    suggested_mapping,
)
from eisp_data.storage.mcap.repair import repair
from eisp_data.storage.mcap.writer import McapWriter
from eisp_data.storage.rewrite import Source, rewrite


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


def test_resume_converts_what_a_repair_had_lost_and_nothing_twice(tmp_path: Path) -> None:
    files = tuple(
        record_session(tmp_path / f"{i}.mcap", episodes=3, steps=5, camera=False) for i in range(2)
    )
    whole, less = tmp_path / "whole", tmp_path / "less"
    convert(ConvertConfig(inputs=files, to=whole))
    kept = Source(read_index(whole), [0, 2, 3, 5])
    rewrite([kept], less, read_spec(whole), read_recipe(whole))
    assert convert(ConvertConfig(inputs=files, to=less, resume=True)).written == 2
    episodes = list(read_episodes(whole))
    expected = [episodes[number] for number in (0, 2, 3, 5, 1, 4)]
    assert all(map(same, expected, read_episodes(less)))
    assert convert(ConvertConfig(inputs=files, to=less, resume=True)).written == 0


def test_in_a_folder_a_repaired_copy_takes_the_place_of_its_original_and_no_file_comes_twice(
    tmp_path: Path, session_file: Path
) -> None:
    whole = session_file.read_bytes()
    folder, other = tmp_path / "in", tmp_path / "in/b.mcap"
    folder.mkdir()
    record_session(other, episodes=1)
    (folder / "a.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    repair(folder / "a.mcap")
    again = folder / ".." / "in" / "b.mcap"
    report = convert(ConvertConfig(inputs=(folder, other, again), to=tmp_path / "d"))
    files = [episode.info["source_file"] for episode in read_episodes(tmp_path / "d")]
    assert files.count("b.mcap") == 1 and set(files) == {"a.repaired.mcap", "b.mcap"}
    assert "a.mcap: left out for its repaired copy, a.repaired.mcap" in report.lines
    # Whoever names the damaged file gets it.
    episodes, _ = run(folder / "a.mcap", tmp_path / "named")
    assert {episode.info["source_file"] for episode in episodes} == {"a.mcap"}


def test_another_recording_or_rule_cannot_be_resumed_into_a_dataset(tmp_path: Path) -> None:
    one = record_session(tmp_path / "a.mcap", episodes=1, camera=False)
    other = record_session(tmp_path / "b.mcap", episodes=2, camera=False)
    run(one, tmp_path / "d")
    with pytest.raises(DataError, match="recipe differs in 'files'"):
        run(other, tmp_path / "d", resume=True)
    with pytest.raises(DataError, match="differs in 'clock'"):
        run(one, tmp_path / "d", resume=True, clock="log")


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
    monkeypatch.setattr(timeline, "MAX_EPISODE_BYTES", 1000)
    with pytest.raises(DataError, match="GiB"):
        run(session_file, target)
    assert not target.exists() or not list(target.glob("[!.]*"))
