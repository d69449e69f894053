"""Kills at random moments and files damaged at random: nothing but the last second is lost.

The counts are small here; EISP_KILLS and EISP_MUTATIONS raise them for a long run.
"""

from __future__ import annotations

import os
import resource
import shutil
import time
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_samples import FAST, record_session
from nursery import Nursery

from eisp_data.errors import EispError
from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap import records
from eisp_data.storage.mcap.check import checks
from eisp_data.storage.mcap.convert import ConvertConfig, convert
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.repair import repair
from eisp_data.storage.mcap.writer import McapWriterConfig
from eisp_data.storage.validate import validate

KILLS = int(os.environ.get("EISP_KILLS", "5"))
MUTATIONS = int(os.environ.get("EISP_MUTATIONS", "100"))
MEMORY_BYTES = 700 * 2**20
"""How much more the process may ever take while it reads damaged files."""

RECORD = """
import time
import cv2
import numpy as np
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.writer import McapWriter
messages.foxglove_class("CompressedImage")
frame = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)

def work(path):
    writer = McapWriter(path)
    k = 0
    while True:
        writer.vector("/command", [k])
        if k % 4 == 0:
            writer.image("/camera/top", frame)
        say("logged", time.time_ns())
        k += 1
        time.sleep(0.008)
"""


def test_a_recorder_that_is_killed_loses_one_second_at_most(tmp_path: Path) -> None:
    rng = np.random.default_rng(KILLS)
    path = tmp_path / "killed.mcap"
    worst = 0.0
    with Nursery(RECORD) as nursery:
        for _ in range(KILLS):
            nursery.start(path)
            first = nursery.line()
            time.sleep(float(rng.uniform(0.0, 1.5)))
            last = [first, *nursery.kill()][-1]
            with McapLog(path) as log:
                kept = list(log.messages({"/command"}))
            last_kept = kept[-1].message.log_time_ns if kept else int(first[1])
            worst = max(worst, (int(last[1]) - last_kept) / 1e9)
            assert [e.message.sequence for e in kept] == list(range(len(kept)))
            if kept:
                copy = repair(path).copy
                with copy.open("rb") as file:
                    count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
                with McapLog(copy) as log:
                    assert log.indexed and not log.problems and count >= len(kept)
                copy.unlink()
            path.unlink()
    print(f"{KILLS} kills while recording: at most {worst:.2f} s lost")
    assert worst <= 1.0


CONVERT = """
import av, cv2, pandas, PIL.Image
from pathlib import Path
from eisp_data.storage.mcap import convert as module
module._BATCH_EPISODES = 2

def work(source, target):
    config = module.ConvertConfig(inputs=(Path(source),), to=Path(target), resume=True)
    say("ready")
    module.convert(config)
    say("done")
"""


def test_a_conversion_killed_again_and_again_ends_in_the_same_dataset(tmp_path: Path) -> None:
    source = record_session(tmp_path / "run.mcap", episodes=12, steps=10)
    convert(ConvertConfig(inputs=(source,), to=tmp_path / "whole"))
    whole = list(read_episodes(tmp_path / "whole", images=True))
    rng = np.random.default_rng(KILLS)
    target = tmp_path / "killed"
    left: Counter[int] = Counter()
    with Nursery(CONVERT) as nursery:
        nursery.start(source, tmp_path / "again")
        assert nursery.line() == ["ready"]
        begin = time.monotonic()
        assert nursery.line() == ["done"]
        takes_s = time.monotonic() - begin
        nursery.kill()
        while (kills := left.total()) < KILLS:
            nursery.start(source, target)
            nursery.line()
            time.sleep(float(rng.uniform(0.0, takes_s)))
            if ["done"] in nursery.kill():
                shutil.rmtree(target)
                continue
            episodes = list(read_episodes(target)) if (target / "data").exists() else []
            left[len(episodes)] += 1
            for a, b in zip(episodes, whole, strict=False):
                assert np.array_equal(a.observation, b.observation) and a.info == b.info
            if kills % 2:
                convert(ConvertConfig(inputs=(source,), to=target, resume=True))
                got = list(read_episodes(target, images=True))
                assert len(got) == len(whole)
                for a, b in zip(got, whole, strict=True):
                    assert np.array_equal(a.observation, b.observation) and a.info == b.info
                    assert a.images["top"].shape == b.images["top"].shape
                assert all(check.passed for check in validate(target))
                shutil.rmtree(target)
    print(f"{KILLS} kills while converting; episodes left: {dict(sorted(left.items()))}")


def mutate(data: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Return a damaged copy of a file and how it was damaged."""
    kind = ("cut", "bits", "hole", "swap", "length", "version", "empty", "payload")[rng.integers(8)]
    out = bytearray(data)
    at = int(rng.integers(len(out)))
    if kind == "cut":
        del out[at:]
    elif kind == "bits":
        for place in rng.integers(len(out), size=int(rng.integers(1, 9))):
            out[place] ^= 1 << int(rng.integers(8))
    elif kind == "hole":
        del out[at : at + int(rng.integers(1, 400))]
    elif kind == "swap":
        out[at : at + 64] = rng.bytes(64)
    elif kind == "length":
        out[at : at + 8] = int(rng.integers(2**63)).to_bytes(8, "little")
    elif kind == "version":
        out[5] = int(rng.integers(256))
    elif kind == "empty":
        out = out[: int(rng.integers(0, 12))]
    else:
        out = bytearray(_damage_payload(data, rng))
    return kind, bytes(out)


def _damage_payload(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip bits inside an uncompressed chunk and set its CRC right, so that only parsers see it."""
    out, chunks, at = bytearray(data), [], len(records.MAGIC)
    while at + 9 < len(data):
        opcode, length = records.RECORD_HEADER.unpack_from(data, at)
        if opcode == 6:
            chunks.append((at + 9, length))
        at += 9 + length
    start, length = chunks[int(rng.integers(len(chunks)))]
    body = start + records.CHUNK_HEADER.size + 8
    for place in rng.integers(body, start + length, size=int(rng.integers(1, 6))):
        out[place] ^= 1 << int(rng.integers(8))
    crc = zlib.crc32(out[body : start + length])
    out[start + 24 : start + 28] = crc.to_bytes(4, "little")
    return bytes(out)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Small whole files: without compression (twice, for payload damage), zstd, lz4."""
    folder = tmp_path_factory.mktemp("samples")
    found = []
    for number, compression in enumerate(("none", "none", "zstd", "lz4")):
        config = McapWriterConfig(compression=compression, chunk_bytes=4096, fsync=False)
        path = record_session(
            folder / f"{number}.mcap", episodes=2, steps=6, camera=number == 1, config=config
        )
        found.append(path.read_bytes())
    return found


def test_damaged_files_give_one_line_or_a_correct_result(
    samples: list[bytes], tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused = dict.fromkeys(("check", "repair", "convert"), 0)
    done = dict(refused)
    for number in range(MUTATIONS):
        sample = number % len(samples)
        kind, data = mutate(samples[sample], rng)
        if kind == "payload" and sample > 1:
            kind, data = mutate(samples[0], rng)
        path = tmp_path / "bad.mcap"
        path.write_bytes(data)
        for name, attempt in (("check", _check), ("repair", _repair), ("convert", _convert)):
            try:
                attempt(path, tmp_path)
                done[name] += 1
            except EispError as error:
                assert str(error) and "\n" not in str(error), f"{number} {kind} {name}"
                refused[name] += 1
            except Exception as error:
                path.rename(tmp_path / f"bad-{number}.mcap")
                raise AssertionError(f"mutation {number} ({kind}): {name}: {error!r}") from error
        assert path.read_bytes() == data
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"{MUTATIONS} mutations: done {done}, refused {refused}, {grown / 2**20:.0f} MiB more")
    assert grown < MEMORY_BYTES


def _check(path: Path, folder: Path) -> None:
    assert len(checks(path)) == 12


def _repair(path: Path, folder: Path) -> None:
    copy = folder / "copy.mcap"
    copy.unlink(missing_ok=True)
    try:
        report = repair(path, copy)
        with copy.open("rb") as file:
            messages = list(make_reader(file, validate_crcs=True).iter_messages())
        assert len(messages) == report.messages
    finally:
        assert not list(folder.glob("*.partial"))


def _convert(path: Path, folder: Path) -> None:
    target = folder / "dataset"
    shutil.rmtree(target, ignore_errors=True)
    report = convert(ConvertConfig(inputs=(path,), to=target))
    assert sum(len(e) for e in read_episodes(target)) == report.frames


def test_the_samples_of_the_fuzz_convert_whole(samples: list[bytes], tmp_path: Path) -> None:
    for data in samples:
        (tmp_path / "good.mcap").write_bytes(data)
        assert all(check.passed for check in checks(tmp_path / "good.mcap"))
        _repair(tmp_path / "good.mcap", tmp_path)
        _convert(tmp_path / "good.mcap", tmp_path)
    assert FAST.fsync is False
