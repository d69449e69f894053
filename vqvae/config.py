"""Every setting of the image stage, each beside its meaning; free of torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from eisp_data.runs import DeviceName


@dataclass(frozen=True)
class VqVaeConfig:
    """The autoencoder."""

    image_size: tuple[int, int] = (48, 48)
    """Height and width, multiples of 8 (appendix "Image-based observation processing")."""
    channels: tuple[int, int] = (64, 128)
    """Of the first two convolutions; the paper does not give them."""
    latent_channels: int = 3
    """Components of a code, and channels of the last convolution (the paper's 3 x 6 x 6)."""
    codes: int = 1024
    """K, the size of the codebook; the paper does not give it."""
    commitment: float = 0.25
    """Weight of the commitment loss (beta of van den Oord et al. 2017)."""
    reading: float = 1.0
    """Weight of the distances in decimetres between where the objects were and where the reader
    reads them; 0 teaches the reader alone, as the paper's VQ-VAE knows no places."""
    decay: float = 0.99
    """Of the moving averages that the codes follow (the same paper, its appendix A.1)."""
    revive_after: int = 100
    """Updates for which a code may go unused before it is put where the data are."""


@dataclass(frozen=True)
class VisionConfig:
    """What an image task sees its worlds with."""

    task: str
    """The task whose images the VQ-VAE was trained on."""
    camera: str
    """Which camera saw them."""
    model: VqVaeConfig
    places: int
    """Coordinates of all objects together, which are read off its latents."""


@dataclass(frozen=True)
class DatasetConfig:
    """A dataset with camera images."""

    root: Path
    """Its folder."""
    camera: str = "shoulder"
    """Which of its cameras."""


@dataclass(frozen=True)
class VqVaeTrainConfig:
    """Training of a VQ-VAE."""

    dataset: DatasetConfig
    output_dir: Path
    """Where the run goes."""
    model: VqVaeConfig = field(default_factory=VqVaeConfig)
    updates: int = 12_000
    reader_updates: int = 8_000
    """After these the codes stay as they are, and so many updates the reader alone learns on."""
    batch_size: int = 256
    lr: float = 1e-3
    """Of Adam at the start."""
    final_lr_share: float = 0.05
    """The learning rate falls along half a cosine to this share of it; 1 keeps it constant."""
    fast: bool = True
    """Convolutions in bfloat16, images channels last: about twice as fast on recent processors."""
    validation_share: float = 0.1
    """Share of the episodes that are held out."""
    validate_every: int = 500
    """Updates between validations, each followed by a checkpoint."""
    seed: int = 0
    device: DeviceName = "auto"
    threads: int = 2
    """Threads of the networks on a processor."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder."""
