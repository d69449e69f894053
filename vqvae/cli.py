"""``eisp-vqvae``: learn a code for camera images, and say how good it is."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast, get_args

import tyro

from eisp_data.cli.run import USER_ERROR, fail, run
from eisp_data.cli.words import given, preset_name, saved_run, take
from eisp_data.errors import ConfigError, EispError
from vqvae.config import VqVaeTrainConfig
from vqvae.presets import PresetName, preset

_ABOUT = """usage: eisp-vqvae COMMAND [OPTIONS]

Learn a code for camera images: the observation and goal of the image tasks.

commands:
  train     train a VQ-VAE on the images of a dataset
  evaluate  how good its images and its codes are, on the episodes that were held out

eisp-vqvae COMMAND --help shows the options of a command."""


@dataclass(frozen=True)
class Evaluate:
    """Options of ``eisp-vqvae evaluate``."""

    path: tyro.conf.Positional[Path]
    """The run, or a folder with the model."""
    root: Path | None = None
    """The dataset; the one that it was trained on if left out."""
    json: bool = False
    """Print JSON instead of a table."""


def main() -> None:
    """Run ``eisp-vqvae``."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(_ABOUT)
        sys.exit(0 if words else USER_ERROR)
    command, rest = words[0], words[1:]
    if command == "train":
        try:
            rest, default = _start(rest)
        except EispError as error:
            fail(str(error))
        run(train, rest, "eisp-vqvae train", config_file=True, default=default)
    elif command == "evaluate":
        run(evaluate, rest, "eisp-vqvae evaluate")
    else:
        fail(f"unknown command {command!r}; choose one of train, evaluate")


def train(config: VqVaeTrainConfig) -> None:
    """Train a VQ-VAE on the camera images of a dataset; print its quality on held-out episodes.

    --preset {cpu,paper} chooses the hyperparameters that the other options start from.
    """
    from vqvae.train import train as learn

    folder, found = learn(config)
    print(f"PSNR                {found.psnr_db:.2f} dB")
    print(f"SSIM                {found.ssim:.4f}")
    print(f"codes in use        {found.used:.1%}, perplexity {found.perplexity:.0f}")
    print(f"model: {folder / 'checkpoints' / 'last'}")


def evaluate(options: tyro.conf.OmitArgPrefixes[Evaluate]) -> None:
    """Measure images, codes, probes and the reach of a VQ-VAE on held-out episodes."""
    from vqvae.evaluate import evaluate as measure

    found = measure(options.path, options.root)
    print(json.dumps(asdict(found), indent=2) if options.json else found.table())


def _start(words: list[str]) -> tuple[list[str], VqVaeTrainConfig | None]:
    words, name = take(words, "--preset")
    resumed = saved_run(words, VqVaeTrainConfig, "vqvae.yaml")
    if resumed or given(words, "--config"):
        if name is not None:
            raise ConfigError("--preset: with --resume or --config all settings come from the file")
        return words, resumed
    known = cast(PresetName, preset_name(name, get_args(PresetName)))
    _, root = take(words, "--dataset.root")
    if root is None and not (given(words, "--help") or given(words, "-h")):
        raise ConfigError("missing --dataset.root, a dataset with images (see eisp-data render)")
    folder = Path("runs/vqvae")
    return words, preset(known, Path(root or "data/images"), folder)


if __name__ == "__main__":
    main()
