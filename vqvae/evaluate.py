"""All that is measured of a VQ-VAE, on episodes that it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eisp_data.config import load_yaml
from eisp_data.errors import ConfigError
from eisp_data.runs.episodes import hold_out, rows_of
from eisp_data.runs.folder import folders_of_run
from eisp_data.sim.pixels import Pixels
from eisp_data.storage.cache import load_arrays, load_images
from eisp_data.tasks.registry import get_task
from vqvae import reading
from vqvae.config import VisionConfig, VqVaeTrainConfig
from vqvae.latents import check_task, encode, load_codes, see
from vqvae.model import VqVae
from vqvae.probe import Probe, probe
from vqvae.quality import Quality, measure
from vqvae.saved import load
from vqvae.train import CONFIG_FILE, spread

_DRAWN = 1000
_MOST = 5_000


@dataclass(frozen=True)
class VqVaeEvaluation:
    """What ``evaluate`` found."""

    task: str
    images: int
    """How many images the quality is of."""
    quality: Quality
    probes: dict[str, Probe]
    """Of each object of the goal."""
    changed_by_video: float | None
    """Share of the codes that storing the images as video changes, None without a simulator."""
    reading: reading.Reading

    def table(self) -> str:
        """Return the figures as text."""
        found, read = self.quality, self.reading
        lines = [
            f"{self.task}: {self.images} images of held-out episodes",
            f"PSNR                      {found.psnr_db:.2f} dB",
            f"SSIM                      {found.ssim:.4f}",
            f"codes in use              {found.used:.1%}, perplexity {found.perplexity:.0f}",
        ]
        lines += [
            f"{name + ' by linear probe':26}{each.latent_mm:.1f} mm from the latent, "
            f"{each.codes_mm:.1f} mm from the codes ({each.unknown_mm:.0f} mm without looking)"
            for name, each in self.probes.items()
        ]
        if self.changed_by_video is not None:
            lines.append(f"codes changed by video    {self.changed_by_video:.2%}")
        lines += [
            f"{name + ' by the reader':26}{mean:.1f} mm, 95% within "
            f"{read.percentile_95_mm[name]:.1f} mm"
            for name, mean in read.mean_mm.items()
        ]
        lines += [
            f"read as within 5 cm       {read.found:.1%} of the pairs of frames that are, "
            f"{1.0 - read.rejected:.1%} of the others",
            f"within 5 cm               {read.right:.1%} of the pairs that are read as such",
        ]
        return "\n".join(lines)


def evaluate(path: Path, root: Path | None = None) -> VqVaeEvaluation:
    """Measure a VQ-VAE on the episodes of its dataset that were held out."""
    model, vision = load(path)
    trained = training_of(path)
    root = root or trained.dataset.root
    arrays = load_arrays(root)
    check_task(root, arrays, vision)
    held, rest = hold_out(root, arrays, trained.validation_share, trained.seed)
    codes = load_codes(root, model, vision.camera)
    seen = see(model, codes)
    places, latents = seen[:, : model.places], seen[:, model.places :]
    rows, held_rows = rows_of(arrays, rest), rows_of(arrays, held)
    chosen = spread(held_rows, _MOST)
    names = [slot.kind for slot in get_task(arrays.spec.task).objects]
    return VqVaeEvaluation(
        task=vision.task,
        images=len(chosen),
        quality=measure(model, load_images(root, vision.camera)[chosen]),
        probes=probe(latents, codes, vision.model.codes, arrays, names, rows, held_rows),
        changed_by_video=_changed(model, vision, arrays.sim_state, codes, held_rows),
        reading=reading.check(places, arrays, held, names),
    )


def _changed(
    model: VqVae, vision: VisionConfig, states: np.ndarray, codes: np.ndarray, rows: np.ndarray
) -> float | None:
    """Return the share of codes that differ between stored images and those drawn anew."""
    if not states.shape[1]:
        return None
    chosen = spread(rows, _DRAWN)
    with Pixels(get_task(vision.task), vision.camera, *vision.model.image_size) as pixels:
        drawn = encode(model, pixels.draw(states[chosen]))
    return float((drawn != codes[chosen]).mean())


def training_of(path: Path) -> VqVaeTrainConfig:
    """Return what a VQ-VAE was trained with."""
    for folder in folders_of_run(path):
        if (folder / CONFIG_FILE).exists():
            return load_yaml(VqVaeTrainConfig, folder / CONFIG_FILE)
    raise ConfigError(f"{path} does not say what it was trained on: no {CONFIG_FILE} above it")
