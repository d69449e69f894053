"""What the tests share, from the precision of products to a small pretrained policy."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch


@pytest.fixture(autouse=True)
def fp32_products() -> Iterator[None]:
    """Undo what a run allows, before and after: it sets the precision for the whole process."""
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"
    yield
    torch.backends.mkldnn.matmul.fp32_precision = "ieee"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Return a function that mounts a disk of so many bytes (``700k``) and returns its folder."""
    folder = tmp_path / "small_disk"

    def mount(size: str) -> Path:
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
        try:
            mounted = subprocess.run(command, capture_output=True).returncode == 0
        except FileNotFoundError:
            mounted = False
        if not mounted:
            pytest.skip("mounting a tmpfs needs privileges that this process has not")
        return folder

    yield mount
    if folder.is_mount():
        # Lazily: what the test mapped may still be mapped.
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture(scope="session")
def stack_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve demonstrations of Stack; not to be changed."""
    from eisp_data.cli.collect import CollectConfig, collect

    root = tmp_path_factory.mktemp("data") / "stack"
    collect(CollectConfig(root, task="stack", episodes=12, workers=1))
    return root


@pytest.fixture(scope="session")
def pretrained(tmp_path_factory: pytest.TempPathFactory, stack_dataset: Path) -> Path:
    """The run of a tiny pretraining on ``stack_dataset``; not to be changed."""
    from learning_samples import tiny_pretraining

    from pretrain.train import pretrain

    return pretrain(tiny_pretraining(stack_dataset, tmp_path_factory.mktemp("runs") / "stack"))
