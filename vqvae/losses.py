"""What the VQ-VAE learns from: reconstruction and commitment (van den Oord et al. 2017, Eq. 3), and
where the objects were, for a block is a small part of a picture and all that matters in it.

The codes follow moving averages, so that the equation's second term is not a loss here.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vqvae.model import VqVae

Info = dict[str, Tensor]


def loss(
    model: VqVae, images: Tensor, places: Tensor, *, fast: bool
) -> tuple[Tensor, Info, tuple[Tensor, Tensor]]:
    """Return the loss on a batch.

    Args:
        model: the VQ-VAE.
        images: (B, H, W, 3) uint8.
        places: (B, P) where the objects were, metres.
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
    # Without a weight, what is read teaches the reader alone and leaves the codes as they are.
    weight = model.config.reading
    latent = (codes if weight else codes.detach()).view(len(images), -1)
    reading = model.reader.loss(latent, places)
    total = reconstruction + model.config.commitment * commitment + (weight or 1.0) * reading
    info = {
        "loss": total.detach(),
        "reconstruction": reconstruction.detach(),
        "commitment": commitment.detach(),
        "reading": reading.detach(),
    }
    return total, info, (vectors.detach(), index)
