"""What is recorded opens in the real MCAP reader, and nothing is lost without being said."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_samples import FAST, START_NS, record_session

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap import writer as writer_module
from eisp_data.storage.mcap.backlog import Backlog, Item
from eisp_data.storage.mcap.check import checks
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.repair import repair
from eisp_data.storage.mcap.writer import McapWriter, McapWriterConfig


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_recording_opens_in_the_real_reader_with_index_and_valid_crcs(
    tmp_path: Path, compression: str
) -> None:
    config = McapWriterConfig(compression=compression, chunk_bytes=4096, fsync=False)
    path = record_session(tmp_path / "run.mcap", episodes=1, config=config)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        decoded = list(reader.iter_decoded_messages())
    assert summary is not None and summary.statistics is not None
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count > 1
    assert {i.compression for i in summary.chunk_indexes} == {compression.replace("none", "")}
    assert len(decoded) == summary.statistics.message_count
    assert {schema.name for schema in summary.schemas.values()} == {
        "foxglove.Event",
        "eisp.Vector",
        "foxglove.JointStates",
        "foxglove.FrameTransforms",
        "foxglove.CompressedImage",
    }


def test_messages_carry_hardware_time_and_log_time(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "run.mcap", FAST) as writer:
        before = writer.now_ns()
        writer.vector("/command", [0.25], START_NS, names=["x_m"], role="action")
        after = writer.now_ns()
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((_, channel, message, decoded),) = reader.iter_decoded_messages()
    assert message.publish_time == START_NS
    assert before <= message.log_time <= after
    assert decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos == START_NS
    assert (list(decoded.names), list(decoded.values)) == (["x_m"], [0.25])
    assert channel.metadata == {"eisp.role": "action"}


def test_the_description_of_a_vector_explains_its_fields() -> None:
    comments = {
        location.leading_comments
        for location in messages.vector_schema().file[-1].source_code_info.location
    }
    assert any("hardware time" in comment.lower() for comment in comments)


def test_poses_are_stored_with_the_scalar_part_of_the_quaternion_as_w() -> None:
    message = messages.pose([1, 2, 3], [0.5, 0.1, 0.2, 0.3], START_NS, "base")
    assert isinstance(message, PoseInFrame)
    assert (message.pose.orientation.w, message.pose.orientation.z) == (0.5, 0.3)
    assert (message.pose.position.x, message.pose.position.z) == (1, 3)


def test_an_image_survives_within_jpeg_error(tmp_path: Path) -> None:
    ramp = np.broadcast_to(np.arange(0, 240, 5, dtype=np.uint8)[None, :, None], (32, 48, 3)).copy()
    with McapWriter(tmp_path / "run.mcap", FAST) as writer:
        assert writer.image("/camera/top/image", ramp)
    from eisp_data.storage.mcap import decode, pixels

    with McapLog(tmp_path / "run.mcap") as log:
        (entry,) = log.messages()
        decoder = decode.Decoder()
        picture = decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
    assert isinstance(picture, decode.Picture)
    assert np.abs(pixels.rgb(picture).astype(int) - ramp).max() <= 8


def test_a_message_may_be_changed_after_it_was_logged(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "run.mcap", FAST) as writer:
        message = messages.vector([1.0], START_NS)
        for value in range(3):
            message.values[0] = value
            writer.log("/x", message)
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert [d.values[0] for *_, d in reader.iter_decoded_messages()] == [0, 1, 2]


def test_a_stalled_disk_costs_images_first_and_each_drop_is_flagged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    monkeypatch.setattr(writer_module.os, "fsync", lambda fd: go_on.wait(30))
    path = tmp_path / "run.mcap"
    frame = np.zeros((64, 64, 3), np.uint8)
    with McapWriter(path, McapWriterConfig(queue_bytes=100_000)) as writer:
        taken = [writer.image("/camera/top/image", frame) for _ in range(30)]
        commands = [writer.vector("/command", [0.0]) for _ in range(20)]
        assert 0 < writer.stats().waiting_bytes <= 100_000
        go_on.set()
    dropped = taken.count(False)
    assert 0 < dropped < 30 and all(commands)
    assert writer.stats().dropped == {"/camera/top/image": dropped}
    assert writer.stats().waiting_bytes == 0
    with McapLog(path) as log:
        stats = log.stats()
        flagged = [
            messages.foxglove_class("Event").FromString(entry.message.data)
            for entry in log.messages({"/events"})
        ]
    counts = [{pair.key: pair.value for pair in event.metadata} for event in flagged]
    assert sum(int(c["count"]) for c in counts if c["kind"] == "dropped") == dropped
    assert stats["/camera/top/image"].count == taken.count(True)


def test_drops_between_two_messages_show_in_the_sequence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    monkeypatch.setattr(writer_module.os, "fsync", lambda fd: go_on.wait(30))
    frame = np.zeros((64, 64, 3), np.uint8)
    with McapWriter(tmp_path / "run.mcap", McapWriterConfig(queue_bytes=100_000)) as writer:
        taken = [writer.image("/camera", frame) for _ in range(30)]
        go_on.set()
        while not writer.image("/camera", frame):
            taken.append(False)
    assert repair(tmp_path / "run.mcap").missing == {"/camera": taken.count(False)}


def test_the_flag_of_a_drop_comes_after_the_events_that_wait_already(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on, encode = threading.Event(), threading.Event(), messages.encode_jpeg

    def slow(image: np.ndarray, quality: int) -> bytes:
        begun.set()
        go_on.wait(30)
        return encode(image, quality)

    monkeypatch.setattr(messages, "encode_jpeg", slow)
    path, frame = tmp_path / "run.mcap", np.zeros((64, 64, 3), np.uint8)
    with McapWriter(path, McapWriterConfig(queue_bytes=100_000, fsync=False)) as writer:
        writer.event("episode_start")
        writer.image("/camera", frame)
        assert begun.wait(30)
        while writer.image("/camera", frame):
            pass
        writer.event("success")
        writer.event("episode_end")
        go_on.set()
    assert writer.stats().dropped == {"/camera": 1}
    with McapLog(path) as log:
        entries = list(log.messages({"/events"}, in_order=False))
    assert [entry.message.sequence for entry in entries] == [0, 1, 2, 3]
    assert all(check.passed for check in checks(path))


def test_the_queue_never_holds_more_than_its_limit() -> None:
    backlog = Backlog(1000)
    sizes = np.random.default_rng(0).integers(1, 400, 500)
    held: list[Item] = []
    for size in sizes:
        backlog.put(Item("/x", b"", 0, 0, 0, int(size)), bulky=bool(size > 200))
        held += backlog.take(0) or []
        assert sum(item.size for item in held) <= 1000
        if size % 3 == 0 and held:
            backlog.done(held.pop(0))
    assert backlog.dropped["/x"] > 0


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(DataError, match="exists already"):
        McapWriter(path)
    assert path.read_bytes() == b"precious"


def test_bad_calls_are_refused_where_they_are_made(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "run.mcap", FAST) as writer:
        writer.vector("/x", [1.0])
        with pytest.raises(DataError, match=r"/x carries eisp\.Vector"):
            writer.log("/x", messages.event("success", 0))
        with pytest.raises(DataError, match="uint8"):
            writer.image("/camera", np.zeros((4, 4)))
        with pytest.raises(DataError, match="choose one of episode_start"):
            writer.event("lunch")
        with pytest.raises(DataError, match="outcome 'maybe'"):
            writer.event("episode_end", outcome="maybe")
        with pytest.raises(ConfigError, match="'acton'; choose one of"):
            writer.vector("/y", [1.0], role="acton")
        with pytest.raises(DataError, match="2 names but 1"):
            writer.log("/j", messages.joints(["a", "b"], [1.0], 0))
    assert writer.stats().written == {"/x": 1}
    with pytest.raises(ConfigError, match="zstd, lz4, none"):
        McapWriterConfig(compression="gzip")  # type: ignore[arg-type]


FULL_DISK = """
import resource, sys
from eisp_data.errors import DataError
from eisp_data.storage.mcap.writer import McapWriter, McapWriterConfig
if len(sys.argv) > 2:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
config = McapWriterConfig(compression="none", chunk_bytes=4096, flush_s=0.01)
writer = McapWriter(sys.argv[1], config)
try:
    while True:
        writer.image("/camera", bytes(1000))
except DataError as error:
    print(error)
try:
    writer.close()
except DataError as error:
    print(error)
"""


def record_until_full(path: Path, *limit: str) -> None:
    """Record until the disk is full; check that it is said, and what is left."""
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path), *limit],
        capture_output=True,
        text=True,
        timeout=60,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2 and all("recording stopped" in line for line in lines), done.stderr
    with McapLog(path) as log:
        count = log.stats()["/camera"].count
        assert count > 100
        assert any("cut off" in problem for problem in log.problems)
    report = repair(path, path.parent.parent / "copy.mcap")
    with report.copy.open("rb") as file:
        assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) >= count


def test_a_full_disk_stops_the_recording_with_one_line_and_leaves_what_was_written(
    small_disk: Callable[[str], Path],
) -> None:
    record_until_full(small_disk("300k") / "run.mcap")


def test_a_recording_that_may_not_grow_stops_with_one_line_too(tmp_path: Path) -> None:
    """The same without privileges: a limit on the size of files, as a quota sets it."""
    (tmp_path / "small").mkdir()
    record_until_full(tmp_path / "small/run.mcap", "200000")
