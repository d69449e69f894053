"""Small datasets for every test of the storage."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from storage_samples import random_episode, spec_of

from eisp_data.cli.data import main
from eisp_data.episode import Episode
from eisp_data.storage.writer import DatasetWriter


@pytest.fixture(autouse=True)
def _caches_beside_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EISP_CACHE", raising=False)


@pytest.fixture
def make_dataset(tmp_path: Path) -> Callable[..., tuple[Path, list[Episode]]]:
    """Return a function that writes a dataset in two batches and returns it with its episodes."""

    def make(
        name: str = "dataset",
        count: int = 5,
        seed: int = 0,
        cameras: bool = False,
        **changes: object,
    ) -> tuple[Path, list[Episode]]:
        spec = spec_of(cameras, **changes)
        episodes = [random_episode(spec, 6 + i, seed + i) for i in range(count)]
        with DatasetWriter(tmp_path / name, spec, {"policy": "script", "seed": seed}) as writer:
            for part in (episodes[:2], episodes[2:]):
                extras = [
                    {n: np.zeros((len(e), w), np.float32) for n, w in spec.extras.items()}
                    for e in part
                ]
                writer.write(part, extras)
        return tmp_path / name, episodes

    return make


@pytest.fixture
def eisp_data(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Return a function that runs ``eisp-data`` and returns status, stdout and stderr."""

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["eisp-data", *map(str, words)])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        said = capsys.readouterr()
        return status, said.out, said.err

    return run
