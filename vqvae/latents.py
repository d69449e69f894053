"""Datasets seen through a VQ-VAE: every image as its codes, computed once.

Codes are kept beside the dataset's array cache under a key of both fingerprints, the dataset's and
the VQ-VAE's: another dataset or other weights are other codes. They are memory-mapped.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from eisp_data.errors import DataError
from eisp_data.sim.pixels import Pixels
from eisp_data.storage.cache import DatasetArrays, cached, load_arrays, load_images
from eisp_data.storage.reader import read_spec
from eisp_data.tasks.images import IMAGE_TASKS, goal_state, image_task
from vqvae.config import VisionConfig
from vqvae.model import VqVae

_BATCH = 512


def check_images(root: Path, camera: str, size: tuple[int, int]) -> None:
    """Raise DataError unless the dataset has images of this camera in this (height, width)."""
    spec = read_spec(root)
    if camera not in spec.cameras:
        known = ", ".join(spec.cameras) or "none"
        raise DataError(
            f"{root}: no images of camera {camera!r}, its cameras are: {known}; "
            f"add them with eisp-data render {root} --cameras {camera} --to FOLDER"
        )
    if spec.cameras[camera] != size:
        (height, width), (wanted_height, wanted_width) = spec.cameras[camera], size
        raise DataError(
            f"{root}: images of camera {camera!r} are {height} x {width}; "
            f"the VQ-VAE takes {wanted_height} x {wanted_width}"
        )


def load_codes(root: Path, model: VqVae, camera: str) -> np.ndarray:
    """Return the codes (R, cells) uint16 of a dataset's images, mapped; rows as in its arrays.

    Raises:
        DataError: no such camera, or images of another size.
    """
    check_images(root, camera, model.config.image_size)
    return cached(
        root,
        f"-{camera}-{model.fingerprint()}",
        lambda folder: np.save(folder / "codes.npy", encode(model, load_images(root, camera))),
        lambda folder: np.load(folder / "codes.npy", mmap_mode="r"),
    )


@torch.no_grad()
def encode(model: VqVae, images: np.ndarray) -> np.ndarray:
    """Return the codes (N, cells) uint16 of (N, H, W, 3) uint8 images."""
    device = model.mean.device
    parts = [
        model.encode(torch.from_numpy(np.array(images[i : i + _BATCH])).to(device)).cpu().numpy()
        for i in range(0, len(images), _BATCH)
    ]
    return np.concatenate(parts).astype(np.uint16)


@torch.no_grad()
def embed(model: VqVae, codes: np.ndarray) -> np.ndarray:
    """Return the latents (N, latent_dim) float32 of (N, cells) codes."""
    index = torch.from_numpy(codes.astype(np.int64)).to(model.mean.device)
    return model.embed(index).cpu().numpy()


def load_latent_arrays(root: Path, model: VqVae, config: VisionConfig) -> DatasetArrays:
    """Return a dataset's arrays as its image task sees them.

    The observation is the robot's own part and the latent of the image, goals are latents: of the
    images that were achieved, and of a picture of the desired goal. All else is unchanged.

    Raises:
        DataError: the dataset is of another task than the VQ-VAE, or has not its images.
    """
    arrays = load_arrays(root)
    spec = arrays.spec
    if spec.task != config.task:
        raise DataError(
            f"{root} is a dataset of {spec.task!r}, the VQ-VAE was trained on {config.task!r}"
        )
    latents = embed(model, load_codes(root, model, config.camera))
    name = image_task(spec.task)
    proprio = arrays.observation[:, : spec.proprio_dim]
    goals = cached(
        root,
        f"-goals-{config.camera}-{model.fingerprint()}",
        lambda f: np.save(f / "codes.npy", _goal_codes(name, arrays.desired_goal, model, config)),
        lambda f: np.load(f / "codes.npy", mmap_mode="r"),
    )
    return replace(
        arrays,
        spec=replace(
            spec,
            task=name,
            observation_dim=spec.proprio_dim + model.latent_dim,
            goal_dim=model.latent_dim,
        ),
        observation=np.hstack([proprio, latents]),
        achieved_goal=latents,
        desired_goal=embed(model, goals),
        places=arrays.achieved_goal,
    )


def _goal_codes(name: str, goals: np.ndarray, model: VqVae, config: VisionConfig) -> np.ndarray:
    task = IMAGE_TASKS[name]
    with Pixels(task, config.camera, *config.model.image_size) as pixels:
        return encode(model, pixels.draw(np.stack([goal_state(task, goal) for goal in goals])))
