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
from eisp_data.storage.cache import DatasetArrays, cached, load_arrays, load_images, unchanged
from eisp_data.storage.reader import read_spec
from eisp_data.tasks.base import OBJECT_DIM
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


def check_task(root: Path, arrays: DatasetArrays, config: VisionConfig) -> None:
    """Raise DataError unless the dataset is of the task that the VQ-VAE was trained on."""
    if arrays.spec.task != config.task:
        raise DataError(
            f"{root} is a dataset of {arrays.spec.task!r}, the VQ-VAE was trained on "
            f"{config.task!r}"
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
def see(model: VqVae, codes: np.ndarray) -> np.ndarray:
    """Return what an agent sees of (N, cells) codes, (N, seen_dim) float32: places and latent."""
    parts = [
        model.see(torch.from_numpy(codes[i : i + _BATCH].astype(np.int64)).to(model.mean.device))
        for i in range(0, len(codes), _BATCH)
    ]
    return torch.cat(parts).cpu().numpy() if parts else np.empty((0, model.seen_dim), np.float32)


def observe(robot: np.ndarray, seen: np.ndarray, places: int) -> np.ndarray:
    """Return the observation (N, 10 + 5 P + latent_dim) of an image task.

    It is laid out as that of the state task, as far as an image says it: the robot's own part, for
    each object its OBJECT_DIM features, of which all but its place and its place from the gripper
    are zero, and the latent.

    Args:
        robot: (N, 10), its first three the place of the gripper.
        seen: (N, seen_dim).
        places: P of its components are places.
    """
    place = seen[:, :places].reshape(len(seen), -1, 3)
    features = np.zeros((*place.shape[:2], OBJECT_DIM), np.float32)
    features[..., :3] = place
    features[..., 3:6] = place - robot[:, None, :3]
    return np.hstack([robot, features.reshape(len(seen), -1), seen[:, places:]])


def load_latent_arrays(root: Path, model: VqVae, config: VisionConfig) -> DatasetArrays:
    """Return a dataset's arrays as its image task sees them.

    The observation is made of what is seen of the image, see ``observe``; goals are what is seen of
    the images that were achieved, and of a picture of the desired goal. All else is unchanged.

    Raises:
        DataError: the dataset is of another task than the VQ-VAE, or has not its images.
    """
    with unchanged(root):
        arrays = load_arrays(root)
        check_task(root, arrays, config)
        seen = see(model, load_codes(root, model, config.camera))
    spec = arrays.spec
    observation = observe(arrays.observation[:, : spec.proprio_dim], seen, model.places)
    name = image_task(spec.task)
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
            observation_dim=observation.shape[1],
            goal_dim=model.seen_dim,
        ),
        observation=observation,
        achieved_goal=seen,
        desired_goal=see(model, goals),
        places=arrays.achieved_goal,
    )


def _goal_codes(name: str, goals: np.ndarray, model: VqVae, config: VisionConfig) -> np.ndarray:
    task = IMAGE_TASKS[name]
    with Pixels(task, config.camera, *config.model.image_size) as pixels:
        return encode(model, pixels.draw(np.stack([goal_state(task, goal) for goal in goals])))
