"""How fast a VQ-VAE learns, against vector-quantize-pytorch as its quantiser, in one run.

    pip install -e '.[bench]'
    python benchmarks/images.py               # prints images/s of both and their ratio

The same encoder, decoder, codebook size, batch, threads and Adam. The peer is what its
documentation shows: its ``VectorQuantize`` with moving averages and dead-code revival, fp32, eager.
Ours is the training step of ``eisp-vqvae train``: own codebook, convolutions in bfloat16 on images
channels last. Turns alternate, so that whatever else the machine does meets both alike; the rates
are those of the median turns, in processor time, which a busy machine distorts least.
"""

from __future__ import annotations

import dataclasses
import statistics
import time

import torch
import tyro
from torch import Tensor, nn

from vqvae.config import VqVaeConfig
from vqvae.model import VqVae
from vqvae.train import step


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    channels: tuple[int, int] = (64, 128)
    codes: int = 512
    batch_size: int = 256
    threads: int = 2
    turns: int = 9
    turn_updates: int = 2


class Ours:
    """The training step of ``eisp-vqvae train``."""

    def __init__(self, config: VqVaeConfig, batch_size: int) -> None:
        torch.manual_seed(0)
        self._model = VqVae(config, 6)
        self._places = torch.zeros(batch_size, 6)
        self._optimizer = torch.optim.Adam(self._model.parameters(), lr=1e-4, fused=True)

    def update(self, images: Tensor) -> None:
        """Learn from one batch."""
        step(self._model, self._optimizer, images, self._places, "cpu", fast=True)


class Peer:
    """The same encoder and decoder around the library's quantiser."""

    def __init__(self, config: VqVaeConfig) -> None:
        from vector_quantize_pytorch import VectorQuantize

        torch.manual_seed(0)
        self._model = VqVae(config, 6)
        self._quantise = VectorQuantize(
            dim=config.latent_channels,
            codebook_size=config.codes,
            decay=config.decay,
            commitment_weight=config.commitment,
            threshold_ema_dead_code=2,
            accept_image_fmap=True,
        )
        self._optimizer = torch.optim.Adam(self._model.parameters(), lr=1e-4)

    def update(self, images: Tensor) -> None:
        """Learn from one batch."""
        target = self._model.standardise(images).contiguous()
        codes, _, commitment = self._quantise(self._model.encoder(target))
        loss = nn.functional.mse_loss(self._model.decoder(codes), target) + commitment.sum()
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()


def main(options: Options) -> None:
    """Run both in turns and print their rates."""
    torch.set_num_threads(options.threads)
    config = VqVaeConfig(channels=options.channels, codes=options.codes)
    images = torch.randint(0, 256, (options.batch_size, 48, 48, 3), dtype=torch.uint8)
    sides: dict[str, Ours | Peer] = {"ours": Ours(config, options.batch_size), "peer": Peer(config)}
    spent: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(options.turns + 1):
        for name, side in sides.items():
            start = time.process_time()
            for _ in range(options.turn_updates):
                side.update(images)
            if turn:  # the first one warms up
                spent[name].append(time.process_time() - start)
    seen = options.turn_updates * options.batch_size
    rates = {name: seen / statistics.median(times) for name, times in spent.items()}
    width = "/".join(map(str, options.channels))
    print(f"width {width}, batch {options.batch_size}, {options.threads} threads")
    print(f"vector-quantize-pytorch  {rates['peer']:8.0f} images per second of processor time")
    print(f"eisp-vqvae               {rates['ours']:8.0f} images per second of processor time")
    print(f"ratio                    {rates['ours'] / rates['peer']:8.2f}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
