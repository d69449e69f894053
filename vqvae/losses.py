"""What the VQ-VAE learns from: reconstruction and commitment (van den Oord et al. 2017, Eq. 3).

The codes follow moving averages, so that the equation's second term is not a loss here.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vqvae.model import VqVae

Info = dict[str, Tensor]


def loss(model: VqVae, images: Tensor, *, fast: bool) -> tuple[Tensor, Info, tuple[Tensor, Tensor]]:
    """Return the loss on a batch.

    Args:
        model: the VQ-VAE.
        images: (B, H, W, 3) uint8.
        fast: convolutions in bfloat16.

    Returns:
        The loss, its parts, and what the codebook follows: vectors (N, D) and indices (N,). The
        reconstruction is in units of the pixels' variance.
    """
    target = model.standardise(images)
    with torch.autocast(target.device.type, torch.bfloat16, enabled=fast):
        vectors = model.vectors(target)
    codes, index = model.codebook(vectors)
    with torch.autocast(target.device.type, torch.bfloat16, enabled=fast):
        decoded = model.decode_cells(codes)
    reconstruction = nn.functional.mse_loss(decoded.float(), target)
    commitment = nn.functional.mse_loss(vectors, model.codebook.code[index])
    total = reconstruction + model.config.commitment * commitment
    info = {
        "loss": total.detach(),
        "reconstruction": reconstruction.detach(),
        "commitment": commitment.detach(),
    }
    return total, info, (vectors.detach(), index)
