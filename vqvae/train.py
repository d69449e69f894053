"""Training of a VQ-VAE on the camera images of a dataset."""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from eisp_data.config import above_zero, at_least, check_seed, load_yaml, zero_to_one
from eisp_data.errors import ConfigError, DataError
from eisp_data.runs import MODEL, checkpoint
from eisp_data.runs.device import choose_device
from eisp_data.runs.episodes import hold_out, rows_of
from eisp_data.runs.folder import begin_run, check_same_dataset, has_progress
from eisp_data.runs.memory import keep_freed_memory
from eisp_data.runs.metrics import MetricsLog
from eisp_data.storage.cache import DatasetArrays, load_arrays, load_images, unchanged
from eisp_data.storage.files import one_line
from vqvae import reading, saved
from vqvae.config import VisionConfig, VqVaeTrainConfig
from vqvae.latents import check_images, load_codes, see
from vqvae.losses import loss
from vqvae.model import STRIDE, VqVae
from vqvae.quality import Quality, measure
from vqvae.reading import on_table

CONFIG_FILE = "vqvae.yaml"
_VALIDATION_IMAGES = 2048
_MOMENT_IMAGES = 4096
_MOST_CODES = 2**16
"""Codes are stored as uint16."""


def train(config: VqVaeTrainConfig) -> tuple[Path, Quality]:
    """Train a VQ-VAE; return the folder of the run and the quality on held-out episodes."""
    run = config.output_dir
    check(config)
    resumed = has_progress(run, config.resume, CONFIG_FILE)
    if resumed:
        begun = load_yaml(VqVaeTrainConfig, run / CONFIG_FILE)
        check_same_dataset(begun.dataset.root, config.dataset.root, run / CONFIG_FILE)
    device = choose_device(config.device)
    torch.set_num_threads(config.threads)
    keep_freed_memory()
    images, arrays, episodes, held_episodes = load_frames(config)
    train_rows, held_rows = rows_of(arrays, episodes), rows_of(arrays, held_episodes)
    # What has fallen off the table is in no picture.
    train_rows = train_rows[on_table(arrays.achieved_goal[train_rows])]
    if not len(train_rows):
        raise DataError(f"{config.dataset.root}: in no frame all objects are on the table")
    places = np.ascontiguousarray(arrays.achieved_goal, np.float32)
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    model = VqVae(config.model, arrays.spec.goal_dim)
    model.set_moments(*moments(images[spread(train_rows, _MOMENT_IMAGES)]))
    model.reader.set_moments(places[train_rows])
    model.to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.lr, fused=True)
    vision = VisionConfig(arrays.spec.task, config.dataset.camera, config.model, model.places)
    done, spent, finished = 0, 0.0, False
    if resumed:
        folder = checkpoint.newest(run)
        try:
            model.load_state_dict(saved.load(folder / MODEL)[0].state_dict())
        except RuntimeError as error:
            raise DataError(f"{folder} cannot be resumed from: {one_line(error)}") from None
        done, numbers, _ = checkpoint.restore(run, {"adam": optimizer}, rng)
        spent, finished = numbers["wall_s"], numbers["finished"]
    begin_run(run, config, CONFIG_FILE)
    log = MetricsLog(run, "vqvae", done)
    start = time.monotonic() - spent
    held = images[spread(held_rows, _VALIDATION_IMAGES)]
    revived = 0

    def save() -> None:
        numbers = {"wall_s": spent, "finished": finished}
        optimizers = {"adam": optimizer}
        write = partial(saved.save, model, vision)
        checkpoint.save(run, done, write, optimizers, rng, numbers, {})

    steps = range(done + 1, config.updates + 1)
    bar = tqdm(steps, "vqvae", config.updates, initial=done, mininterval=1.0)
    for update in bar:
        optimizer.param_groups[0]["lr"] = learning_rate(config, update)
        # Sorted, for the images are mapped from a file.
        rows = np.sort(train_rows[rng.integers(len(train_rows), size=config.batch_size)])
        batch = torch.from_numpy(images[rows]), torch.from_numpy(places[rows])
        info, fresh = step(model, optimizer, *batch, device, config.fast)
        revived += fresh
        if update % config.validate_every == 0 or update == config.updates:
            quality = measure(model, held)
            bar.set_postfix(psnr=quality.psnr_db, used=quality.used)
            done, spent, finished = update, time.monotonic() - start, False
            values: dict[str, float | Tensor] = {f"train/{k}": v for k, v in info.items()}
            values |= {f"held_out/{k}": v for k, v in asdict(quality).items()}
            log.write(update, 0, spent, values | {"train/revived": revived})
            if update < config.updates:
                save()
            revived = 0
    log.close()
    if not finished:
        codes = load_codes(config.dataset.root, model, config.dataset.camera)
        latents = see(model, codes[train_rows])[:, model.places :]
        reading.learn(model.reader, latents, places[train_rows], config.reader_updates, rng)
        finished, spent = True, time.monotonic() - start
        save()
    return run, measure(model, held)


def step(
    model: VqVae,
    optimizer: torch.optim.Optimizer,
    images: Tensor,
    places: Tensor,
    device: str,
    fast: bool,
) -> tuple[dict[str, Tensor], int]:
    """Update the model on (B, H, W, 3) images of objects at (B, P); return the losses and how many
    codes revived."""
    total, info, assigned = loss(model, images.to(device), places.to(device), fast=fast)
    optimizer.zero_grad(set_to_none=True)
    total.backward()
    optimizer.step()
    return info, model.codebook.follow(*assigned)


def learning_rate(config: VqVaeTrainConfig, update: int) -> float:
    """Return the learning rate of an update: half a cosine down to the final share."""
    falling = 0.5 * (1.0 + math.cos(math.pi * update / config.updates))
    return config.lr * (config.final_lr_share + (1.0 - config.final_lr_share) * falling)


def check(config: VqVaeTrainConfig) -> None:
    """Raise ConfigError, naming the option, unless the settings can be used."""
    model = config.model
    at_least(
        1,
        {
            "--updates": config.updates,
            "--reader-updates": config.reader_updates,
            "--batch-size": config.batch_size,
            "--validate-every": config.validate_every,
            "--threads": config.threads,
            "--model.latent-channels": model.latent_channels,
            "--model.codes": model.codes,
            "--model.revive-after": model.revive_after,
        },
    )
    check_seed(config.seed)
    above_zero({"--lr": config.lr})
    if model.codes > _MOST_CODES:
        raise ConfigError(f"--model.codes must be at most {_MOST_CODES}; got {model.codes}")
    at_least(0, {"--model.reading": model.reading, "--model.commitment": model.commitment})
    zero_to_one({"--final-lr-share": config.final_lr_share})
    for flag, share in (
        ("--validation-share", config.validation_share),
        ("--model.decay", model.decay),
    ):
        if not 0 < share < 1:
            raise ConfigError(f"{flag} must be between 0 and 1; got {share}")
    if any(size < STRIDE or size % STRIDE for size in model.image_size):
        said = " x ".join(map(str, model.image_size))
        raise ConfigError(f"--model.image-size must be multiples of {STRIDE}; got {said}")


def load_frames(
    config: VqVaeTrainConfig,
) -> tuple[np.ndarray, DatasetArrays, np.ndarray, np.ndarray]:
    """Return a dataset's images (R, H, W, 3), mapped, its arrays, and which of its episodes to
    learn from and which are held out.

    Raises:
        DataError: no such dataset or camera, images of another size, or too few episodes.
    """
    root, camera = config.dataset.root, config.dataset.camera
    check_images(root, camera, config.model.image_size)
    with unchanged(root):
        images, arrays = load_images(root, camera), load_arrays(root)
    held, rest = hold_out(root, arrays, config.validation_share, config.seed)
    return images, arrays, rest, held


def spread(rows: np.ndarray, count: int) -> np.ndarray:
    """Return at most ``count`` of the rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(np.int64))]


def moments(images: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return the mean (H, W, 3) of (N, H, W, 3) uint8 images, in 0..1, and how far each colour
    deviates from it, (3,)."""
    pixels = images.astype(np.float32) / 255.0
    mean = pixels.mean(0)
    return torch.from_numpy(mean), torch.from_numpy((pixels - mean).std((0, 1, 2)))
