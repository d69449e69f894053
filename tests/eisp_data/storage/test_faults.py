"""SIGKILL at random moments, and a disk that is full: only the batch in hand is lost.

``EISP_KILLS=200`` in the environment kills that often.
"""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from nursery import Nursery
from storage_samples import assert_same, random_episode, spec_of

from eisp_data.errors import DataError
from eisp_data.storage.lerobot import DatasetWriter, read_episodes
from eisp_data.storage.repair import repair
from eisp_data.storage.validate import validate

KILLS = int(os.environ.get("EISP_KILLS", "6"))
BATCH = 3

COLLECT = """
import av, pandas
from storage_samples import random_episode, spec_of
from eisp_data.storage.lerobot import DatasetWriter
spec = spec_of(cameras=True)

def work(root):
    with DatasetWriter(root, spec, {"kind": "kill"}, resume=True) as writer:
        say("open", writer.num_episodes)
        while True:
            first = writer.num_episodes
            writer.write([random_episode(spec, 6, first + i) for i in range(3)])
            say("wrote", writer.num_episodes)
"""


def kill_one(nursery: Nursery, root: Path, batches: int, delay_s: float) -> int:
    """Start a writer, kill it some time after so many batches; return what it promised."""
    nursery.start(root)
    said = [nursery.line() for _ in range(1 + batches)]
    time.sleep(delay_s)
    return int([*said, *nursery.kill()][-1][1])


def check_upstream(root: Path, episodes: int, frames: int) -> None:
    """Open a dataset with LeRobot and read its first and last frame, image included."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("test/killed", root=root)
    assert dataset.num_episodes == episodes and len(dataset) == frames
    spec = spec_of(cameras=True)
    for step in (0, frames - 1):
        item = dataset[step]
        episode = random_episode(spec, 6, step // 6)
        assert np.array_equal(item["action"], episode.action[step % 6])
        image = item["observation.images.top"].numpy().transpose(1, 2, 0) * 255
        assert np.abs(image - episode.images["top"][step % 6]).mean() < 4


def test_a_kill_at_any_moment_loses_at_most_the_batch_in_hand(tmp_path, monkeypatch):
    """The process is killed at a random moment, opened by LeRobot, validated, and resumed."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path / "hf"))
    spec = spec_of(cameras=True)
    draw = random.Random(1)
    root, states = tmp_path / "killed", Counter[str]()
    with Nursery(COLLECT) as nursery:
        for kill in range(KILLS):
            if kill % 10 == 0:
                root = tmp_path / f"killed-{kill}"
            promised = kill_one(nursery, root, draw.randrange(3), draw.uniform(0, 0.06))
            kept = list(read_episodes(root, images=True)) if (root / "data").exists() else []
            # What the writer said is there; at most one more batch can be, whole.
            assert len(kept) in (promised, promised + BATCH)
            for number, episode in enumerate(kept):
                assert_same(random_episode(spec, 6, number), episode)
            if not kept:
                states["killed before the first batch"] += 1
                continue
            bad = [check.name for check in validate(root) if not check.passed]
            assert set(bad) <= {"episode count", "frame count", "no stray files", "statistics"}, bad
            states[", ".join(bad) or "nothing to mend"] += 1
            stated = json.loads((root / "meta/info.json").read_text())
            if stated["total_episodes"]:
                check_upstream(root, stated["total_episodes"], stated["total_frames"])
            if kill % 5 == 0:
                copy = repair(root, tmp_path / f"repaired-{kill}").copy
                assert all(check.passed for check in validate(copy))
                for ours, theirs in zip(kept, read_episodes(copy), strict=True):
                    assert_same(ours, theirs)
    print(dict(states))
    DatasetWriter(root, spec, {"kind": "kill"}, resume=True).close()
    if (root / "data").exists():
        assert all(check.passed for check in validate(root))


def _fill_up(root: Path) -> tuple[int, str]:
    """Write batches until the disk is full; return how many episodes were promised."""
    spec = spec_of(cameras=True)
    with DatasetWriter(root, spec, {}) as writer:
        for first in range(0, 3000, BATCH):
            try:
                writer.write([random_episode(spec, 6, first + i) for i in range(BATCH)])
            except DataError as error:
                return writer.num_episodes, str(error)
    raise AssertionError("the disk was never full")


def _check_full(root: Path, promised: int, message: str) -> None:
    assert f"the {promised} episodes written before are safe" in message and "\n" not in message
    kept = list(read_episodes(root, images=True))
    assert len(kept) == promised > 0
    for number, episode in enumerate(kept):
        assert_same(random_episode(spec_of(cameras=True), 6, number), episode)
    assert all(check.passed for check in validate(root))


def test_a_full_disk_is_one_clear_line_and_the_finished_part_is_whole(small_disk):
    root = small_disk("700k") / "dataset"
    promised, message = _fill_up(root)
    assert "No space left on device" in message
    _check_full(root, promised, message)


def test_a_full_disk_stops_the_array_cache_in_one_line(small_disk, make_dataset):
    """In a process of its own: a mapped file without room would kill it."""
    root, _ = make_dataset(count=20, cameras=True)
    folder = small_disk("60k")
    code = (
        "import sys\n"
        "from eisp_data.errors import DataError\n"
        "from eisp_data.storage.cache import load_arrays, load_images\n"
        "for load in (load_arrays, lambda root: load_images(root, 'top')):\n"
        "    try:\n"
        "        load(sys.argv[1])\n"
        "    except DataError as error:\n"
        "        print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(root)],
        env={**os.environ, "EISP_CACHE": str(folder)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert len(lines) == 2, lines
    assert all("cannot write the array cache" in x and "No space left" in x for x in lines)
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_a_file_that_may_not_grow_is_one_clear_line(tmp_path):
    """The same without privileges: a limit on the size of files, as a quota sets it."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    spec = spec_of()
    with DatasetWriter(tmp_path / "d", spec, {}) as writer:
        writer.write([random_episode(spec, 6, 0)])
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, limits[1]))
        try:
            with pytest.raises(DataError, match="the 1 episodes written before are safe"):
                writer.write([random_episode(spec, 900, 1)])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        writer.write([random_episode(spec, 6, 1)])
    assert all(check.passed for check in validate(tmp_path / "d"))
    assert [episode.seed for episode in read_episodes(tmp_path / "d")] == [0, 1]
