"""How good images come back from their codes, and how well the codebook is used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from vqvae.model import VqVae

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
"""Window and constants of Wang et al. 2004, for images in 0..1."""


@dataclass(frozen=True)
class Quality:
    """Means over images that were not learned from."""

    psnr_db: float
    ssim: float
    perplexity: float
    """Exponential of the entropy of the codes: how many are used as if all alike."""
    used: float
    """Share of the codes that occur at all."""


def psnr(images: Tensor, others: Tensor) -> Tensor:
    """Return (B,) peak signal-to-noise ratios in dB of (B, H, W, 3) uint8 images."""
    apart = (images.float() - others.float()) / 255.0
    return -10.0 * apart.square().mean((1, 2, 3)).clamp(min=1e-10).log10()


def ssim(images: Tensor, others: Tensor) -> Tensor:
    """Return (B,) structural similarities (Wang et al. 2004) of (B, H, W, 3) uint8 images.

    The mean over the three colours and over all places where the whole window fits.
    """
    x, y = (each.permute(0, 3, 1, 2).float() / 255.0 for each in (images, others))
    offsets = torch.arange(_WINDOW, dtype=torch.float32) - _WINDOW // 2
    bell = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    bell = (bell / bell.sum()).to(x.device)
    window = torch.outer(bell, bell).expand(3, 1, -1, -1).contiguous()

    def blur(values: Tensor) -> Tensor:
        return nn.functional.conv2d(values, window, groups=3)

    mean_x, mean_y = blur(x), blur(y)
    var_x = blur(x * x) - mean_x.square()
    var_y = blur(y * y) - mean_y.square()
    covariance = blur(x * y) - mean_x * mean_y
    alike = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    apart = (mean_x.square() + mean_y.square() + _C1) * (var_x + var_y + _C2)
    return (alike / apart).mean((1, 2, 3))


def perplexity(counts: Tensor) -> float:
    """Return the perplexity of codes that occur (K,) times."""
    share = counts.double() / counts.sum()
    return float(torch.special.entr(share).sum().exp())


@torch.no_grad()
def measure(model: VqVae, images: np.ndarray, batch: int = 512) -> Quality:
    """Return the quality on (N, H, W, 3) uint8 images."""
    device = model.mean.device
    ratios, likenesses = [], []
    counts = torch.zeros(len(model.codebook), dtype=torch.int64)
    for start in range(0, len(images), batch):
        own = torch.from_numpy(np.array(images[start : start + batch])).to(device)
        index = model.encode(own)
        again = model.decode(model.embed(index))
        ratios.append(psnr(own, again))
        likenesses.append(ssim(own, again))
        counts += torch.bincount(index.flatten().cpu(), minlength=len(counts))
    return Quality(
        float(torch.cat(ratios).mean()),
        float(torch.cat(likenesses).mean()),
        perplexity(counts),
        float((counts > 0).float().mean()),
    )
