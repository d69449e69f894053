"""Where things are, read off the latents by a linear map: what a policy could know of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from eisp_data.storage.cache import DatasetArrays
from vqvae.reading import on_table

_RIDGE = 1.0
_MOST_ROWS = 200_000
"""Cells x K weights are to be found from them."""
_ITERATIONS, _ACCURACY, _TINY = 100, 1e-3, 1e-30


@dataclass(frozen=True)
class Probe:
    """Mean distances in millimetres between where an object is and where a probe says it is."""

    latent_mm: float
    """A linear map of the latent, 108 numbers."""
    codes_mm: float
    """A linear map of which code each cell has: what a first layer that knows the codes sees."""
    unknown_mm: float
    """Without looking: the mean place of all frames."""


def probe(
    latents: np.ndarray,
    codes: np.ndarray,
    count: int,
    arrays: DatasetArrays,
    names: list[str],
    rows: np.ndarray,
    held_rows: np.ndarray,
) -> dict[str, Probe]:
    """Fit the probes and return their errors on held-out rows.

    Args:
        latents: (R, D).
        codes: (R, cells) indices below ``count``.
        count: K.
        arrays: of the dataset; its achieved goal is [x, y, z] of one object after the other.
        names: of these objects.
        rows: to fit on.
        held_rows: to measure on.
    """
    places = arrays.achieved_goal.reshape(len(arrays.achieved_goal), -1, 3)
    found = {}
    for index, name in enumerate(names):
        place = np.asarray(places[:, index], np.float64)
        seen = on_table(place)
        fit, held = (_thin(part[seen[part]]) for part in (rows, held_rows))
        truth = place[held] - place[fit].mean(0)
        centred = place[fit] - place[fit].mean(0)
        found[name] = Probe(
            latent_mm=_error(_latent_map(latents, fit, held, centred), truth),
            codes_mm=_error(_code_map(codes, count, fit, held, centred), truth),
            unknown_mm=_error(np.zeros_like(truth), truth),
        )
    return found


def _thin(rows: np.ndarray) -> np.ndarray:
    return rows[:: -(-len(rows) // _MOST_ROWS)] if len(rows) else rows


def _error(guess: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(guess - truth, axis=1).mean() * 1000.0)


def _latent_map(
    latents: np.ndarray, fit: np.ndarray, held: np.ndarray, target: np.ndarray
) -> np.ndarray:
    mean, std = latents[fit].mean(0), latents[fit].std(0)
    std[std < 1e-6 * std.max()] = 1.0
    inputs, others = (((latents[part] - mean) / std).astype(float) for part in (fit, held))
    inputs, others = (
        np.hstack([x, np.ones((len(x), 1))]).astype(np.float64) for x in (inputs, others)
    )
    gram = inputs.T @ inputs + _RIDGE * np.eye(inputs.shape[1])
    return others @ np.linalg.solve(gram, inputs.T @ target)


def _code_map(
    codes: np.ndarray, count: int, fit: np.ndarray, held: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Ridge regression on cells x K indicators, by conjugate gradients (Hestenes and Stiefel)."""
    cells = codes.shape[1]
    offsets = np.arange(cells) * count
    inputs, others = (
        torch.from_numpy(codes[part].astype(np.int64) + offsets) for part in (fit, held)
    )
    columns = inputs.flatten()

    def forward(rows: Tensor, weights: Tensor) -> Tensor:
        return nn.functional.embedding_bag(rows, weights, mode="sum")

    def backward(values: Tensor) -> Tensor:
        each = values.repeat_interleave(cells, 0)
        return values.new_zeros(cells * count, values.shape[1]).index_add_(0, columns, each)

    residual = backward(torch.from_numpy(target).float())
    weights = torch.zeros_like(residual)
    direction, size = residual, residual.square().sum(0)
    first = size
    for _ in range(_ITERATIONS):
        curved = backward(forward(inputs, direction)) + _RIDGE * direction
        step = size / (direction * curved).sum(0).clamp(min=_TINY)
        weights = weights + step * direction
        residual = residual - step * curved
        before, size = size, residual.square().sum(0)
        if (size <= _ACCURACY**2 * first).all():
            break
        direction = residual + size / before.clamp(min=_TINY) * direction
    return forward(others, weights).numpy()
