"""What the tests of learning share: a small dataset of Stack, and a policy pretrained on it."""

from __future__ import annotations

from pathlib import Path

import pytest


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
