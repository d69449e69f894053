"""The VQ-VAE of image tasks (van den Oord et al. 2017), in the sizes of the paper's appendix.

Encoder: three convolutions of 4 x 4 with stride 2, the last with as many channels as a code has
components, so that a 3 x 48 x 48 image becomes a 3 x 6 x 6 latent: 36 codes of 3 components. The
decoder mirrors it.
"""

from __future__ import annotations

import hashlib
import json

import torch
from torch import Tensor, nn

from eisp_data.config import to_plain
from vqvae.codebook import Codebook
from vqvae.config import VqVaeConfig
from vqvae.deconvolution import Double
from vqvae.reading import Reader

STRIDE = 8
"""Pixels of an image along each side of a code."""
_LEAST_STD = 1e-3


class VqVae(nn.Module):
    """Images to codes and back, and to the places of the objects.

    Args:
        config: the hyperparameters.
        places: coordinates of all objects together that ``reader`` reads off a latent.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, config: VqVaeConfig, places: int) -> None:
        super().__init__()
        self.config = config
        first, second = config.channels
        depth = config.latent_channels
        self.encoder = nn.Sequential(
            _halve(3, first),
            nn.ReLU(inplace=True),
            _halve(first, second),
            nn.ReLU(inplace=True),
            _halve(second, depth),
        )
        self.codebook = Codebook(config.codes, depth, config.decay, config.revive_after)
        self.decoder = nn.Sequential(
            Double(depth, second),
            nn.ReLU(inplace=True),
            Double(second, first),
            nn.ReLU(inplace=True),
            Double(first, 3),
        )
        self.register_buffer("mean", torch.zeros(3, *config.image_size))
        self.register_buffer("std", torch.ones(3, 1, 1))
        self.places = places
        self.reader = Reader(self.latent_dim, places)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of codes."""
        height, width = self.config.image_size
        return height // STRIDE, width // STRIDE

    @property
    def latent_dim(self) -> int:
        """Components of an image's latent: 108 for the paper's 3 x 6 x 6."""
        rows, columns = self.grid
        return self.config.latent_channels * rows * columns

    @property
    def seen_dim(self) -> int:
        """Components of what an agent sees of an image."""
        return self.latent_dim + self.places

    def standardise(self, images: Tensor) -> Tensor:
        """Return (B, H, W, 3) uint8 RGB images as the networks see them, (B, 3, H, W) float32."""
        return (images.permute(0, 3, 1, 2).float() / 255.0 - self.mean) / self.std

    def picture(self, decoded: Tensor) -> Tensor:
        """Return the decoder's (B, 3, H, W) as (B, H, W, 3) uint8 RGB."""
        pixels = (decoded.float() * self.std + self.mean).clamp(0.0, 1.0) * 255.0
        return pixels.round().to(torch.uint8).permute(0, 2, 3, 1)

    def vectors(self, images: Tensor) -> Tensor:
        """Return the encoder's (B * cells, D) vectors of standardised images, cell after cell."""
        return self.encoder(images).float().permute(0, 2, 3, 1).flatten(0, 2)

    def decode_cells(self, cells: Tensor) -> Tensor:
        """Return the decoder's (B, 3, H, W) for (B * cells, D) codes."""
        rows, columns = self.grid
        latent = cells.unflatten(0, (-1, rows, columns)).permute(0, 3, 1, 2)
        return self.decoder(latent)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Return the indices (B, cells) of the codes of (B, H, W, 3) uint8 images."""
        rows, columns = self.grid
        index = self.codebook.nearest(self.vectors(self.standardise(images)))
        return index.view(len(images), rows * columns)

    def embed(self, index: Tensor) -> Tensor:
        """Return the latents (B, latent_dim) of (B, cells) indices, cell after cell."""
        return self.codebook.code[index].flatten(1)

    @torch.no_grad()
    def see(self, index: Tensor) -> Tensor:
        """Return what an agent sees of (B, cells) indices, (B, seen_dim): the places in metres
        that are read off the latent, and the latent."""
        latent = self.embed(index)
        return torch.cat([self.reader(latent), latent], 1)

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """Return the (B, H, W, 3) uint8 images of (B, latent_dim) latents.

        Each cell is first put onto the code nearest to it, which leaves a latent of ``embed`` as
        it is and makes a picture of one that a generator proposed.
        """
        cells = latent.reshape(-1, self.config.latent_channels)
        return self.picture(self.decode_cells(self.codebook.code[self.codebook.nearest(cells)]))

    def fingerprint(self) -> str:
        """Return a key of the weights: what was encoded by another model is of another key.

        The reader is left out, for codes do not depend on it.
        """
        digest = hashlib.sha256(json.dumps(to_plain(self.config)).encode())
        for name, tensor in sorted(self.state_dict().items()):
            if not name.startswith("reader."):
                digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]

    def set_moments(self, mean: Tensor, std: Tensor) -> None:
        """Set what images are standardised with: the mean image (H, W, 3), so that codes are spent
        on what changes, and the deviation (3,) of each colour from it, of pixels in 0..1."""
        self.mean.copy_(mean.permute(2, 0, 1))
        self.std.copy_(std.clamp(min=_LEAST_STD).view(3, 1, 1))


def _halve(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel_size=4, stride=2, padding=1)
