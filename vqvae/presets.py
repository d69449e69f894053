"""Named sets of hyperparameters: the paper's, made for a GPU, and ours, made for two cores."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vqvae.config import DatasetConfig, VqVaeConfig, VqVaeTrainConfig

PresetName = Literal["cpu", "paper"]


def preset(name: PresetName, root: Path, output_dir: Path) -> VqVaeTrainConfig:
    """Return the training of a VQ-VAE by the name of its preset."""
    return _PRESETS[name](root, output_dir)


def _paper(root: Path, output_dir: Path) -> VqVaeTrainConfig:
    """The appendix "Image-based observation processing": Adam, 1e-4, batch 256, 1e6 steps."""
    return VqVaeTrainConfig(
        dataset=DatasetConfig(root),
        output_dir=output_dir,
        model=VqVaeConfig(reading=0.0),
        updates=1_000_000,
        batch_size=256,
        lr=1e-4,
        final_lr_share=1.0,
        fast=False,
        validate_every=5_000,
    )


def _cpu(root: Path, output_dir: Path) -> VqVaeTrainConfig:
    """Half the batch, thirty times the learning rate, and that falling."""
    return VqVaeTrainConfig(
        dataset=DatasetConfig(root),
        output_dir=output_dir,
        model=VqVaeConfig(codes=2048),
        updates=12_000,
        batch_size=128,
        lr=3e-3,
    )


_PRESETS = {"cpu": _cpu, "paper": _paper}
