"""Laplace distributions over subgoals: densities, divergences, samples."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def log_prob(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return log p(value), summed over the last dimension."""
    return log_probs(value, mean, scale).sum(-1)


def log_probs(value: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Return log p(value) of each dimension."""
    return -(value - mean).abs() / scale - (2 * scale).log()


def evened(log_probs: Tensor, scale: Tensor) -> Tensor:
    """Return what to learn from: the log p of each dimension, times the root of its scale.

    The gradient of a mean is 1 / scale: what is known to the millimetre drowns out what is not yet
    known at all, and that stays so. With the root they are heard more evenly; where the optimum
    lies is the same (beta-NLL, Seitzer et al. 2022, with beta 1/2).
    """
    return log_probs * scale.detach().sqrt()


def kl_to_standard_normal(mean: Tensor, scale: Tensor) -> Tensor:
    """Return KL(Laplace(mean, scale) || N(0, 1)), summed over the last dimension.

    The entropy of the Laplace is 1 + log 2b, and E[x^2] = mean^2 + 2 b^2.
    """
    cross = 0.5 * math.log(2 * math.pi) + 0.5 * mean.square() + scale.square()
    return (cross - 1 - (2 * scale).log()).sum(-1)


def sample(mean: Tensor, scale: Tensor) -> Tensor:
    """Return a reparameterised sample."""
    uniform = torch.rand_like(mean) - 0.5
    return mean - scale * uniform.sign() * torch.log1p(-2 * uniform.abs().clamp(max=0.499999))
