"""Whatever is whole in a file is read, and what is not is said; repair makes it whole."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_samples import FAST, START_NS

from eisp_data.errors import DataError
from eisp_data.storage.mcap import records, scan
from eisp_data.storage.mcap.check import checks
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.repair import repair, repaired_path
from eisp_data.storage.mcap.writer import McapWriter


def contents(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Return all messages by the real reader."""
    with path.open("rb") as file:
        return [
            (channel.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, channel, m in make_reader(file, validate_crcs=True).iter_messages()
        ]


def read(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Return all messages by our reader."""
    with McapLog(path) as log:
        return [
            (topic, m.log_time_ns, m.publish_time_ns, m.sequence, m.data)
            for topic, _, m in log.messages()
        ]


def damaged(path: Path, data: bytes) -> Path:
    """Write ``data`` beside the tests' files."""
    path.write_bytes(data)
    return path


def test_it_reads_what_the_real_reader_reads(session_file: Path) -> None:
    assert sorted(read(session_file)) == sorted(contents(session_file))
    with McapLog(session_file) as log:
        assert log.indexed and not log.problems
        assert log.header() == ("", "eisp-data")
        assert log.metadata()["session"] == {"task": "stack", "instruction": "Stack it."}


def test_messages_come_in_the_order_of_log_time_even_if_chunks_overlap(tmp_path: Path) -> None:
    times = [5, 1, 9, 3, 2, 8, 4, 7, 6, 0]
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=40)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        for at in times:
            writer.add_message(channel, at, b"{}", at)
        writer.finish()
    with McapLog(tmp_path / "x.mcap") as log:
        assert len(log.layout.segments) > 2
        assert [e.message.log_time_ns for e in log.messages()] == sorted(times)
        assert [e.message.log_time_ns for e in log.messages(in_order=False)] == times
        some = log.messages(start_ns=3, end_ns=7)
        assert [e.message.log_time_ns for e in some] == [3, 4, 5, 6]


def test_messages_of_one_channel_can_be_chosen(session_file: Path) -> None:
    with McapLog(session_file) as log:
        assert {entry.topic for entry in log.messages({"/command"})} == {"/command"}


@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_cut_anywhere_gives_all_messages_before_the_cut_chunk(
    tmp_path: Path, session_file: Path, chunked: bool
) -> None:
    data = session_file.read_bytes()
    if not chunked:
        with (tmp_path / "loose.mcap").open("wb") as file, McapLog(session_file) as log:
            writer = Writer(file, use_chunking=False, compression=CompressionType.NONE)
            writer.start()
            channel = writer.register_channel("/x", "json", 0)
            for entry in log.messages():
                m = entry.message
                writer.add_message(channel, m.log_time_ns, m.data, m.publish_time_ns)
            writer.finish()
        data = (tmp_path / "loose.mcap").read_bytes()
    whole = damaged(tmp_path / "whole.mcap", data)
    with McapLog(whole) as log:
        ends = [s.offset + s.length for s in log.layout.segments]
        everything = list(log.messages(in_order=False))
        starts = [s.offset for s in log.layout.segments]
    for cut in range(len(records.MAGIC), len(data), max(1, len(data) // 60)):
        path = damaged(tmp_path / "cut.mcap", data[:cut])
        with McapLog(path) as log:
            got = list(log.messages(in_order=False))
            assert got == everything[: len(got)]
            segments = log.layout.segments
            assert any("cut off" in problem for problem in log.problems) or cut >= ends[-1]
        if chunked:
            assert [s.offset for s in segments] == [
                s for s, end in zip(starts, ends, strict=True) if end <= cut
            ]
        elif cut >= ends[0]:
            assert got


def test_a_flipped_bit_costs_one_chunk_and_is_reported(tmp_path: Path, session_file: Path) -> None:
    data = bytearray(session_file.read_bytes())
    with McapLog(session_file) as log:
        chunks, total = log.layout.segments, len(list(log.messages()))
        per_chunk = [len(list(log._segment(chunk))) for chunk in chunks]
    for number, chunk in enumerate(chunks):
        data[chunk.offset + 200] ^= 0x10
        path = damaged(tmp_path / "flipped.mcap", bytes(data))
        data[chunk.offset + 200] ^= 0x10
        with McapLog(path) as log:
            assert len(list(log.messages())) == total - per_chunk[number]
            assert len(log.problems) == 1 and f"byte {chunk.offset}" in log.problems[0]


def test_a_damaged_length_loses_only_the_chunk_it_belongs_to(
    tmp_path: Path, session_file: Path
) -> None:
    data = session_file.read_bytes()
    with McapLog(session_file) as log:
        chunks = log.layout.segments
    for bad in (0, 2**40, len(data) // 2, chunks[1].length + 1):
        at = chunks[1].offset + 1
        path = damaged(
            tmp_path / "length.mcap", data[:at] + struct.pack("<Q", bad) + data[at + 8 :]
        )
        with McapLog(path) as log:
            offsets = {s.offset for s in log.layout.segments}
        assert offsets == {c.offset for c in chunks} - {chunks[1].offset}


def test_a_file_without_its_summary_is_read_whole(tmp_path: Path, session_file: Path) -> None:
    data = session_file.read_bytes()
    path = damaged(tmp_path / "killed.mcap", data[:-30])
    assert sorted(read(path)) == sorted(contents(session_file))
    with McapLog(path) as log:
        assert not log.indexed


def test_channels_are_found_in_a_summary_that_has_moved_when_the_first_chunk_is_lost(
    tmp_path: Path, session_file: Path
) -> None:
    data = session_file.read_bytes()
    with McapLog(session_file) as log:
        first = log.layout.segments[0]
        lost = len(list(log._segment(first)))
        total = len(list(log.messages()))
    at = first.offset + 300
    path = damaged(tmp_path / "hole.mcap", data[:at] + data[at + 50 :])
    with McapLog(path) as log:
        assert not log.indexed
        assert len(list(log.messages())) == total - lost


def test_a_chunk_that_claims_to_be_huge_is_not_believed() -> None:
    for compression, data in ((b"zstd", b"\x28\xb5\x2f\xfd" + b"\xff" * 20), (b"lz4", b"\x04\x22")):
        with pytest.raises(records.BadRecord):
            records.decompress(records.Chunk(0, 0, 100, 0, compression, data))
    huge = struct.pack("<QQQII", 0, 0, 2**40, 0, 4) + b"zstd" + struct.pack("<Q", 0)
    with pytest.raises(records.BadRecord, match="limit"):
        records.chunk_header(huge, len(huge))


def test_a_bomb_yields_no_more_than_its_stated_size() -> None:
    import lz4.frame
    import zstandard

    bomb = bytes(50_000_000)
    packed = ((b"zstd", zstandard.compress(bomb)), (b"lz4", lz4.frame.compress(bomb)))
    for compression, data in packed:
        with pytest.raises(records.BadRecord, match="1001 bytes, states 1000"):
            records.decompress(records.Chunk(0, 0, 1000, 0, compression, data))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "empty file"),
        (b"\x89MCAP1\r\n" + bytes(50), "version"),
        (b"PAR1" + bytes(50), "not an MCAP file"),
    ],
)
def test_what_is_no_mcap_file_is_refused_in_one_line(
    tmp_path: Path, data: bytes, message: str
) -> None:
    path = damaged(tmp_path / "x.mcap", data)
    for attempt in (McapLog, repair, checks):
        with pytest.raises(DataError, match=message) as caught:
            attempt(path)
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="No such file"):
        McapLog(tmp_path / "absent.mcap")


def test_a_repaired_copy_holds_the_same_messages_and_the_original_is_untouched(
    tmp_path: Path, session_file: Path
) -> None:
    data = session_file.read_bytes()
    path = damaged(tmp_path / "run.mcap", data[: len(data) * 2 // 3])
    path.chmod(0o444)
    before = path.stat().st_mtime_ns
    report = repair(path)
    assert report.copy == repaired_path(path)
    assert path.read_bytes() == data[: len(data) * 2 // 3]
    assert path.stat().st_mtime_ns == before
    kept = contents(report.copy)
    assert len(kept) == report.messages > 50
    assert sorted(kept) == sorted(read(path))
    assert all(
        check.passed for check in checks(report.copy) if check.name in ("whole", "decodable")
    )
    assert any("cut off" in line for line in report.lines())
    with McapLog(report.copy) as log, McapLog(session_file) as original:
        assert log.metadata() == original.metadata()
        assert {t: c.metadata for t, c in log.topics.items()} == {
            t: c.metadata for t, c in original.topics.items() if t in log.topics
        }


def test_a_repair_never_overwrites_and_leaves_nothing_behind_when_it_fails(
    tmp_path: Path, session_file: Path
) -> None:
    path = damaged(tmp_path / "run.mcap", session_file.read_bytes()[:-30])
    damaged(repaired_path(path), b"precious")
    with pytest.raises(DataError, match="exists already"):
        repair(path)
    with pytest.raises(DataError, match="exists already"):
        repair(path, path)
    assert repaired_path(path).read_bytes() == b"precious"
    empty = damaged(tmp_path / "empty.mcap", session_file.read_bytes()[:30])
    with pytest.raises(DataError, match="nothing to repair"):
        repair(empty)
    assert {p.name for p in tmp_path.iterdir()} == {
        "run.mcap", "run.repaired.mcap", "empty.mcap"
    }  # fmt: skip


def test_attachments_and_metadata_survive_a_repair(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("profile", "library")
        writer.add_attachment(1, 2, "calibration.yaml", "text/yaml", b"fx: 600")
        writer.add_metadata("m", {"a": "b"})
        channel = writer.register_channel("/x", "json", 0)
        writer.add_message(channel, 5, b"{}", 6, 7)
        writer.finish()
    report = repair(path)
    with report.copy.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "profile"
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ("calibration.yaml", b"fx: 600")
    assert contents(report.copy) == [("/x", 5, 6, 7, b"{}")]


def test_checks_name_what_is_wrong(tmp_path: Path, session_file: Path) -> None:
    path = tmp_path / "stuck.mcap"
    from eisp_data.storage.mcap import messages

    with McapWriter(path, FAST) as writer:
        writer.event("episode_start")
        for k in range(60):
            at = START_NS + k
            writer.log("/joint_states", messages.joints(["a"], [1.0], at), writer.now_ns())
            writer.vector("/command", [float("nan") if k == 3 else 0.0])
        writer.image("/camera", b"not a jpeg")
    results = {check.name: check for check in checks(path)}
    wrong = {"finite", "decodable", "episodes"}
    assert {name for name, check in results.items() if not check.passed} == wrong
    assert {name for name, check in results.items() if check.warning} == {"not stuck"}
    assert "/joint_states: 60 times" in results["not stuck"].detail
    assert "1 started, 0 ended" in results["episodes"].detail
    cut = damaged(tmp_path / "cut.mcap", session_file.read_bytes()[:-30])
    assert not {check.name: check for check in checks(cut)}["whole"].passed


@pytest.mark.parametrize(
    ("library", "messages", "missing"),
    [
        ("other", [("/a", 0), ("/b", 0), ("/a", 1), ("/a", 4), ("/b", 1)], {"/a": 2}),
        ("other", [("/a", 7), ("/a", 9)], {"/a": 1}),
        ("other", [("/once", 0), ("/a", 7), ("/a", 9)], {"/a": 1}),
        ("one count for all", [("/a", 1), ("/b", 2), ("/b", 3), ("/a", 4), ("/b", 7)], {}),
        ("two publishers", [("/a", 1), ("/a", 90), ("/a", 2), ("/a", 91)], {}),
        ("none", [("/a", 0), ("/b", 0), ("/a", 0)], {}),
        ("eisp-data", [("/a", 1), ("/b", 2), ("/b", 3), ("/a", 4)], {"/a": 2}),
        ("eisp-data", [("/a", 1), ("/a", 5), ("/a", 2)], {"/a": 3}),
    ],
)
def test_numbers_that_do_not_count_a_channel_show_no_loss_on_it(
    tmp_path: Path, library: str, messages: list[tuple[str, int]], missing: dict[str, int]
) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library=library)
        channels = {t: writer.register_channel(t, "json", 0) for t in sorted(dict(messages))}
        for at, (topic, number) in enumerate(messages):
            writer.add_message(channels[topic], at, b"{}", at, number)
        writer.finish()
    (check,) = [check for check in checks(path) if check.name == "nothing dropped"]
    assert check.passed == (not missing)
    assert all(f"{topic}: {n} missing" in check.detail for topic, n in missing.items()), (
        check.detail
    )
    assert repair(path).missing == missing


def test_the_walk_holds_no_more_than_one_segment(session_file: Path) -> None:
    with McapLog(session_file) as log:
        assert max(s.length for s in log.layout.segments) < 2 * FAST.chunk_bytes
    assert scan.LOOSE_SEGMENT_BYTES <= 2**20
