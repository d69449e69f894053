"""A drawn dataset and a VQ-VAE trained on it, made once."""

from __future__ import annotations

from pathlib import Path

import pytest
from image_samples import drawn_dataset, skip_without_opengl, tiny_training


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drawn demonstrations of OpenDrawer; not to be changed."""
    skip_without_opengl()
    return drawn_dataset(tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="session")
def vqvae_run(tmp_path_factory: pytest.TempPathFactory, images: Path) -> Path:
    """The run of a tiny VQ-VAE on ``images``; not to be changed."""
    from vqvae.train import train

    return train(tiny_training(images, tmp_path_factory.mktemp("runs") / "vqvae"))[0]
