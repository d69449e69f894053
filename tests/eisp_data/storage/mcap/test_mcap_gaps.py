"""What a recording lacks is repeated and flagged, aged, left out or reported, never silent."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap_samples import FAST, PERIOD_NS, START_NS, rows, run

from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap import writer as writer_module
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.writer import McapWriter, McapWriterConfig
from eisp_data.storage.validate import validate


def instant(writer: McapWriter, k: int) -> int:
    """Record what each test needs beside what it tests, at step ``k``; return its time."""
    at = START_NS + k * PERIOD_NS
    writer.log("/joint_states", messages.joints(["a"], [k], at), at)
    writer.vector("/command", [0.0], at, role="action")
    writer.vector("/reached", [k], at, role="observation.achieved_goal")
    return at


def test_a_frame_dropped_while_recording_is_repeated_flagged_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk_goes_on = threading.Event()
    monkeypatch.setattr(writer_module.os, "fsync", lambda fd: disk_goes_on.wait(30))
    taken = []
    with McapWriter(tmp_path / "x.mcap", McapWriterConfig(queue_bytes=400_000)) as writer:
        for k in range(51):
            at = instant(writer, k)
            taken.append(writer.image("/camera/top", np.full((64, 64, 3), 5 * k, np.uint8), at))
            if k == 40:
                disk_goes_on.set()
                while writer.stats().waiting_bytes:
                    time.sleep(0.01)
        writer.event("episode_end", at)
    taken = taken[:50]  # the last is the last observation, which is no row
    assert taken[0] and 10 < taken.count(False) < 40
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    flags = rows(tmp_path / "d")["repeated.top"]
    assert (flags == ~np.array(taken)).all()
    (seen,) = read_episodes(tmp_path / "d", images=True)
    shown = np.maximum.accumulate(np.where(taken, np.arange(50), 0))
    np.testing.assert_allclose(seen.images["top"][:50].mean(axis=(1, 2, 3)), 5 * shown, atol=4)
    drops = taken.count(False)
    assert f"x.mcap: /camera/top: {drops} messages dropped while recording" in report.lines
    assert episode.info["repeated_frames"] == drops
    said = f"{drops} of 50 rows repeat a frame, for the next one was lost"
    assert any(said in line for line in report.lines)
    (check,) = [check for check in validate(tmp_path / "d") if check.name == "repeated frames"]
    assert check.warning and check.detail == f"top {drops} of 50 rows ({drops / 50:.1%})"


def test_a_camera_that_is_slower_than_the_rows_repeats_nothing_that_was_lost(
    session_file: Path, tmp_path: Path
) -> None:
    run(session_file, tmp_path / "d")
    assert not rows(tmp_path / "d")["repeated.top"].any()
    (check,) = [check for check in validate(tmp_path / "d") if check.name == "repeated frames"]
    assert check.verdict == "ok" and check.detail == "none"


def record_dead_camera(path: Path, ended: bool) -> None:
    """Record 51 instants of an episode, with or without its end; the camera dies at the 21st."""
    with McapWriter(path, FAST) as writer:
        writer.event("episode_start", START_NS)
        for k in range(51):
            at = instant(writer, k)
            if k <= 20:
                writer.image("/camera/top", np.zeros((16, 16, 3), np.uint8), at)
        if ended:
            writer.event("episode_end", at)


def test_a_dead_camera_is_reported_and_its_age_grows(tmp_path: Path) -> None:
    record_dead_camera(tmp_path / "x.mcap", ended=True)
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    assert len(episode) == 50 and episode.info["gaps"] == 1
    gap, repeats = report.lines
    assert "camera.top: no sample for 1.20 s, from 0.80 s on" in gap
    assert "camera.top: 29 of 50 rows repeat a frame" in repeats
    assert np.flatnonzero(rows(tmp_path / "d")["repeated.top"]).tolist() == list(range(21, 50))
    assert rows(tmp_path / "d")["age_s.camera.top"][-1] == pytest.approx(29 * 0.04, abs=1e-5)


def test_what_is_left_out_after_the_first_source_stopped_is_told(tmp_path: Path) -> None:
    record_dead_camera(tmp_path / "x.mcap", ended=False)
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    assert len(episode) == 20
    assert report.lines == [
        "x.mcap: episode at 0.00 s: camera.top stops at 0.80 s; 1.20 s after it left out"
    ]


def test_a_source_that_goes_on_after_the_last_episode_has_ended_is_no_loss(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        writer.event("episode_start", START_NS)
        for k in range(51):
            at = START_NS + k * PERIOD_NS if k > 20 else instant(writer, k)
            writer.image("/camera/top", np.zeros((16, 16, 3), np.uint8), at)
            if k == 20:
                writer.event("episode_end", at)
    (episode,), report = run(tmp_path / "x.mcap", tmp_path / "d")
    assert len(episode) == 20 and report.lines == []


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
