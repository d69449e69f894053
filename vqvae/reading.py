"""Where the objects are, read off the latent of an image: what "reached" means to an image task.

Elsewhere a goal is reached when all objects are within 5 cm of their places, Eq. (1). Latents have
no metres, and an object is a small part of a picture: by the distance of latents a shut drawer with
the block in it and one with the block beside it are the same place. So a perceptron learns from the
frames of the dataset, which knows where everything was, to read the places off the latent. Two
images are then as far apart as the places that are read off them, and every tolerance in metres
means for images what it means for states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from eisp_data.storage.cache import DatasetArrays
from eisp_data.tasks.base import SUCCESS_DISTANCE_M

_WIDTH = 256
_BATCH, _LR = 512, 1e-3
_LEAST_STD = 1e-3
_ON_TABLE_M = 0.6
"""Further from the robot's base than this, or below the table, nothing is in the picture."""
_PAIRS = 20_000
_FURTHEST_STEPS = 60


class Reader(nn.Module):
    """A perceptron from latents to places, and a linear map that is to learn the same.

    The linear one is never asked. What it loses shapes the codes of a VQ-VAE that learns with it,
    for a latent that says plainly where things are is easy to read for everything else.

    Args:
        latent_dim: components of a latent.
        places: coordinates of all objects together, three each.
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, latent_dim: int, places: int) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(places))
        self.register_buffer("spread", torch.ones(places))
        self.layers = nn.Sequential(
            nn.Linear(latent_dim, _WIDTH),
            nn.ReLU(inplace=True),
            nn.Linear(_WIDTH, _WIDTH),
            nn.ReLU(inplace=True),
            nn.Linear(_WIDTH, places),
        )
        self.plain = nn.Linear(latent_dim, places)

    def forward(self, latent: Tensor) -> Tensor:
        """Return the places (B, P) in metres of (B, latent_dim) latents."""
        return self._places(self.layers(latent))

    def set_moments(self, places: np.ndarray) -> None:
        """Set where the places (N, P) are about."""
        self.centre.copy_(torch.from_numpy(places.mean(0)))
        self.spread.copy_(torch.from_numpy(places.std(0).clip(min=_LEAST_STD)))

    def loss(self, latent: Tensor, places: Tensor) -> Tensor:
        """Return how far in decimetres objects are from where both read them, added up."""
        read = torch.stack([self(latent), self._places(self.plain(latent))])
        return (read - places).unflatten(-1, (-1, 3)).norm(dim=-1).mean((1, 2)).sum() * 10.0

    def _places(self, scaled: Tensor) -> Tensor:
        return scaled * self.spread + self.centre


def learn(
    reader: Reader,
    latents: np.ndarray,
    places: np.ndarray,
    updates: int,
    rng: np.random.Generator,
) -> None:
    """Learn on to read places (N, P) in metres off latents (N, latent_dim), which stay as they
    are."""
    device = reader.centre.device
    seen, truth = (torch.from_numpy(part).to(device) for part in (latents, places))
    optimizer = torch.optim.Adam(reader.parameters(), lr=_LR, fused=True)
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = _LR * 0.5 * (1.0 + math.cos(math.pi * update / updates))
        rows = torch.from_numpy(rng.integers(len(seen), size=_BATCH)).to(device)
        optimizer.zero_grad(set_to_none=True)
        reader.loss(seen[rows], truth[rows]).backward()
        optimizer.step()


def on_table(places: np.ndarray) -> np.ndarray:
    """Return whether each row (N, P) has all objects, [x, y, z] each, where a camera sees them."""
    each = places.reshape(len(places), -1, 3)
    return (np.abs(each).max(-1) < _ON_TABLE_M).all(1) & (each[..., 2] > 0.0).all(1)


@dataclass(frozen=True)
class Reading:
    """How well places are read, and pairs of frames within 5 cm told from the others."""

    mean_mm: dict[str, float]
    """Mean distance between where an object is and where it is read, by its name."""
    percentile_95_mm: dict[str, float]
    found: float
    """Share of the pairs of frames within 5 cm that are read as such."""
    rejected: float
    """Share of the other pairs that are not."""
    right: float
    """Share of the pairs that are read as within 5 cm and are."""


def check(
    read: np.ndarray, arrays: DatasetArrays, episodes: np.ndarray, names: list[str]
) -> Reading:
    """Return how well the places of the named episodes are read.

    Args:
        read: (R, P) places in metres, rows as in the arrays.
        arrays: of the dataset; its achieved goal is [x, y, z] of one object after the other.
        episodes: which of its episodes.
        names: of these objects.
    """
    first, second = _pairs(arrays, episodes)
    true, seen = arrays.achieved_goal, read
    shown = on_table(true[first]) & on_table(true[second])
    first, second = first[shown], second[shown]
    each = np.linalg.norm((seen[first] - true[first]).reshape(len(first), -1, 3), axis=-1) * 1e3
    near, reached = (
        np.linalg.norm(of[first] - of[second], axis=1) <= SUCCESS_DISTANCE_M for of in (true, seen)
    )
    return Reading(
        mean_mm={name: float(each[:, i].mean()) for i, name in enumerate(names)},
        percentile_95_mm={
            name: float(np.percentile(each[:, i], 95)) for i, name in enumerate(names)
        },
        found=_share(reached[near]),
        rejected=_share(~reached[~near]),
        right=_share(near[reached]),
    )


def _pairs(arrays: DatasetArrays, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw (_PAIRS,) rows and as many a little later in the same episode."""
    rng = np.random.default_rng(0)
    start, stop = arrays.episode_start[episodes], arrays.episode_start[episodes + 1]
    which = rng.integers(len(episodes), size=_PAIRS)
    first = rng.integers(start[which], stop[which])
    # As many near pairs as far ones: the logarithm of the time between them is uniform.
    steps = np.exp(rng.uniform(0.0, np.log(_FURTHEST_STEPS), _PAIRS)).astype(np.int64)
    return first, np.minimum(first + steps, stop[which] - 1)


def _share(hits: np.ndarray) -> float:
    return float(hits.mean()) if len(hits) else float("nan")
