"""What the tests of images share: drawn demonstrations of OpenDrawer, and a tiny VQ-VAE on them."""

from __future__ import annotations

from pathlib import Path

import pytest

from eisp_data.errors import ConfigError
from vqvae.config import VqVaeConfig, VqVaeTrainConfig
from vqvae.presets import preset

TINY = VqVaeConfig(channels=(8, 16), codes=32, revive_after=5)


def skip_without_opengl() -> None:
    """Skip the test where nothing can be drawn."""
    from eisp_data.sim.pixels import Pixels
    from eisp_data.tasks.registry import get_task

    try:
        Pixels(get_task("open_drawer"), "shoulder", 48, 48).close()
    except ConfigError as error:
        pytest.skip(str(error))


def drawn_dataset(folder: Path, episodes: int = 4) -> Path:
    """Return a new dataset of OpenDrawer with images of the shoulder camera."""
    from eisp_data.cli.collect import CollectConfig, collect
    from eisp_data.replay import render

    collect(CollectConfig(folder / "states", task="open_drawer", episodes=episodes, workers=1))
    render(folder / "states", folder / "images", {"shoulder": (48, 48)})
    return folder / "images"


def tiny_training(root: Path, output_dir: Path, **changes: object) -> VqVaeTrainConfig:
    """Return the training of a tiny VQ-VAE in a few dozen updates."""
    from dataclasses import replace

    config = preset("cpu", root, output_dir)
    values: dict[str, object] = {
        "model": TINY,
        "updates": 160,
        "reader_updates": 300,
        "validate_every": 40,
        "batch_size": 16,
        "lr": 5e-3,
        "validation_share": 0.25,
        "device": "cpu",
        "threads": 1,
    }
    return replace(config, **{**values, **changes})  # type: ignore[arg-type]
