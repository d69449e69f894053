"""How far apart the latents of one place are: what "reached" means to an image task.

Elsewhere a goal is reached within 5 cm. Latents have no metres, so pairs of frames a little apart
in time are taken from the data, and the distance of latents is chosen that best tells the pairs
within 5 cm (gripper and objects together, all that an image shows) from the others. Latents are
then scaled so that this distance is 0.05, and every tolerance in metres means for images what it
means for states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from eisp_data.storage.cache import DatasetArrays
from eisp_data.tasks.base import SUCCESS_DISTANCE_M
from vqvae.latents import embed
from vqvae.model import VqVae

_PAIRS = 20_000
_FURTHEST_STEPS = 60
_GRIPPER = slice(0, 3)


@dataclass(frozen=True)
class Calibration:
    """How well the distance of latents tells pairs of frames within 5 cm from the others."""

    distance: float
    """Of unscaled latents: nearer means reached."""
    found: float
    """Share of the pairs within 5 cm that are as near as that."""
    rejected: float
    """Share of the other pairs that are not."""
    right: float
    """Share of the pairs as near as that whose objects, the gripper aside, are within 5 cm."""


def distances(
    model: VqVae, codes: np.ndarray, arrays: DatasetArrays, episodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how far apart pairs of frames of the named episodes are.

    Returns:
        (P,) distances of latents without their scale, of gripper and objects together in metres,
        and of the objects alone in metres.
    """
    rng = np.random.default_rng(0)
    start, stop = arrays.episode_start[episodes], arrays.episode_start[episodes + 1]
    which = rng.integers(len(episodes), size=_PAIRS)
    first = rng.integers(start[which], stop[which])
    # As many near pairs as far ones: the logarithm of the time between them is uniform.
    steps = np.exp(rng.uniform(0.0, np.log(_FURTHEST_STEPS), _PAIRS)).astype(np.int64)
    second = np.minimum(first + steps, stop[which] - 1)
    apart = embed(model, codes[first]) - embed(model, codes[second])
    latent = np.linalg.norm(apart, axis=1) / float(model.unit)
    objects = arrays.achieved_goal[first] - arrays.achieved_goal[second]
    gripper = arrays.observation[first, _GRIPPER] - arrays.observation[second, _GRIPPER]
    every = np.linalg.norm(np.hstack([gripper, objects]), axis=1)
    return latent, every, np.linalg.norm(objects, axis=1)


def best_threshold(values: np.ndarray, near: np.ndarray) -> float:
    """Return the value that tells near from far best: most found plus most rejected.

    Args:
        values: (P,) distances; smaller should be near.
        near: (P,) bool.
    """
    order = np.argsort(values, kind="stable")
    found = np.cumsum(near[order]) / max(1, near.sum())
    mistaken = np.cumsum(~near[order]) / max(1, (~near).sum())
    # Equal values fall on the same side of any threshold.
    last = np.append(np.diff(values[order]) > 0, True)
    score = np.where(last, found - mistaken, -np.inf)
    return float(values[order][score.argmax()])


def calibrate(
    model: VqVae, codes: np.ndarray, arrays: DatasetArrays, episodes: np.ndarray
) -> float:
    """Set the scale of the model's latents from the named episodes; return the distance found."""
    latent, every, _ = distances(model, codes, arrays, episodes)
    distance = best_threshold(latent, every <= SUCCESS_DISTANCE_M)
    model.unit.fill_(SUCCESS_DISTANCE_M / max(distance, 1e-6))
    return distance


def check(
    model: VqVae, codes: np.ndarray, arrays: DatasetArrays, episodes: np.ndarray
) -> Calibration:
    """Return how well the model's scale does on the named episodes."""
    latent, every, objects = distances(model, codes, arrays, episodes)
    threshold = SUCCESS_DISTANCE_M / float(model.unit)
    # Rounding must not put what is exactly at the threshold beyond it.
    reached, near = latent <= threshold * (1.0 + 1e-5), every <= SUCCESS_DISTANCE_M
    return Calibration(
        distance=threshold,
        found=_share(reached[near]),
        rejected=_share(~reached[~near]),
        right=_share(objects[reached] <= SUCCESS_DISTANCE_M),
    )


def _share(hits: np.ndarray) -> float:
    return float(hits.mean()) if len(hits) else float("nan")
