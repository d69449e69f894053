"""The array cache: the same numbers as the episodes, rebuilt when they change."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator

import numpy as np
import pytest
from storage_samples import random_episode, spec_of

from eisp_data.errors import DataError
from eisp_data.storage.cache import (
    DatasetArrays,
    cached,
    fingerprint,
    load_arrays,
    load_images,
    unchanged,
)
from eisp_data.storage.lerobot import DatasetWriter

ROWS = ("observation", "achieved_goal", "success", "sim_state")
STEPS = ("action", "reward", "done", "truncated")


def check(arrays, episodes):
    """Compare arrays with the episodes they come from."""
    assert arrays.num_episodes == len(episodes)
    assert arrays.num_steps == sum(map(len, episodes))
    for number, (rows, episode) in enumerate(zip(episode_slices(arrays), episodes, strict=True)):
        for name in ROWS:
            assert np.array_equal(getattr(arrays, name)[rows], getattr(episode, name)), name
        for name in STEPS:
            values = getattr(arrays, name)[rows]
            assert np.array_equal(values[:-1], getattr(episode, name)), name
            assert not values[-1].any()
        assert np.array_equal(arrays.desired_goal[number], episode.desired_goal)
        assert arrays.seed[number] == episode.seed
        assert arrays.info[number] == episode.info


def episode_slices(arrays: DatasetArrays) -> Iterator[slice]:
    """Yield the rows of each episode."""
    for start, stop in zip(arrays.episode_start[:-1], arrays.episode_start[1:], strict=True):
        yield slice(int(start), int(stop))


def test_rows_are_the_episodes_one_after_the_other(make_dataset):
    root, episodes = make_dataset()
    check(load_arrays(root), episodes)


def append_to(root) -> None:
    with DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True) as writer:
        writer.write([random_episode(spec_of(), 4, 99)])


def test_what_was_built_while_a_writer_was_at_work_is_built_again(make_dataset):
    root, episodes = make_dataset()
    built = []

    def fill(folder):
        built.append(len(load_arrays(root).seed))
        if len(built) == 1:
            append_to(root)
        (folder / "count").write_text(str(built[-1]))

    said = cached(root, "-count", fill, lambda folder: (folder / "count").read_text())
    assert built == [len(episodes), len(episodes) + 1] and said == str(len(episodes) + 1)


def test_parts_of_a_dataset_that_grows_are_not_put_together(make_dataset):
    root, _ = make_dataset()
    with pytest.raises(DataError, match="changed while it was read; wait"), unchanged(root):
        append_to(root)


def test_arrays_are_mapped_not_read_and_cannot_be_written(make_dataset):
    root, _ = make_dataset(count=40)
    arrays = load_arrays(root)
    assert isinstance(arrays.observation, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        arrays.observation[0] = 0


def test_new_data_rebuilds_the_cache_and_removes_the_old_one(make_dataset):
    root, episodes = make_dataset()
    before = fingerprint(root)
    load_arrays(root)
    more = random_episode(spec_of(), 4, 99)
    with DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True) as writer:
        writer.write([more])
    assert fingerprint(root) != before
    check(load_arrays(root), [*episodes, more])
    assert [entry.name for entry in (root / ".cache/eisp").iterdir()] == [fingerprint(root)]


def test_an_unchanged_dataset_is_not_built_twice(make_dataset, monkeypatch):
    root, episodes = make_dataset()
    load_arrays(root)
    monkeypatch.setattr("eisp_data.storage.cache._build", None)
    check(load_arrays(root), episodes)


def test_a_read_only_dataset_is_cached_elsewhere(make_dataset, tmp_path, monkeypatch):
    root, episodes = make_dataset()
    monkeypatch.setenv("EISP_CACHE", str(tmp_path / "cache"))
    check(load_arrays(root), episodes)
    assert not (root / ".cache").exists()
    monkeypatch.delenv("EISP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    access = os.access
    monkeypatch.setattr(os, "access", lambda p, m: str(root) not in str(p) and access(p, m))
    check(load_arrays(root), episodes)
    assert any((tmp_path / "home/eisp").iterdir())


def test_images_have_the_rows_of_the_arrays(make_dataset):
    root, episodes = make_dataset(cameras=True)
    images, arrays = load_images(root, "top"), load_arrays(root)
    assert isinstance(images, np.memmap) and len(images) == len(arrays.reward)
    for rows, episode in zip(episode_slices(arrays), episodes, strict=True):
        assert np.abs(images[rows].astype(int) - episode.images["top"]).mean() < 4
    assert len(list((root / ".cache/eisp").iterdir())) == 2
    with pytest.raises(DataError, match=r"no camera 'wrist'; there are top"):
        load_images(root, "wrist")


def _load(root, barrier, results):
    barrier.wait()
    results.put(float(load_arrays(root).observation.sum()))


def test_two_processes_may_build_it_at_once(make_dataset):
    root, _ = make_dataset(count=30)
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(3), context.Queue()
    workers = [context.Process(target=_load, args=(root, barrier, results)) for _ in range(3)]
    for worker in workers:
        worker.start()
    sums = {results.get(timeout=30) for _ in workers}
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert sums == {float(load_arrays(root).observation.sum())}
    assert [entry.name for entry in (root / ".cache/eisp").iterdir()] == [fingerprint(root)]
