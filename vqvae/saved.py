"""VQ-VAEs on the disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from eisp_data.config import from_plain, to_plain
from eisp_data.errors import ConfigError, DataError
from eisp_data.runs import MODEL
from eisp_data.storage.files import one_line, replace_atomically, write_json
from vqvae.config import VisionConfig

if TYPE_CHECKING:  # it needs torch, and a command line has to be read before
    from vqvae.model import VqVae


def save(model: VqVae, vision: VisionConfig, folder: Path) -> None:
    """Write ``config.json`` and ``model.safetensors``, each whole or not at all."""
    from safetensors.torch import save_file

    tensors = {name: value.cpu().contiguous() for name, value in model.state_dict().items()}
    replace_atomically(folder / "model.safetensors", lambda path: save_file(tensors, path))
    write_json(folder / "config.json", {"vision": to_plain(vision)})


def find(path: Path) -> Path:
    """Return the folder of the VQ-VAE for a path that names it, its checkpoint or its run."""
    for folder in (path, path / MODEL, path / "checkpoints" / "last" / MODEL):
        if (folder / "model.safetensors").exists() and (folder / "config.json").exists():
            return folder
    raise DataError(f"{path} holds no VQ-VAE; give a run of eisp-vqvae train")


def load_config(path: Path) -> VisionConfig:
    """Return what a VQ-VAE on the disk is, without its weights."""
    folder = find(path)
    try:
        plain = json.loads((folder / "config.json").read_text())
        if "vision" not in plain:
            raise DataError(f"{path} holds a policy, not a VQ-VAE")
        return from_plain(VisionConfig, plain["vision"])
    except (OSError, ValueError, ConfigError) as error:
        raise DataError(f"{path} holds no readable VQ-VAE: {one_line(error)}") from None


def load(path: Path) -> tuple[VqVae, VisionConfig]:
    """Return a VQ-VAE and what it is; DataError if it cannot be read."""
    from safetensors.torch import load_file

    from vqvae.model import VqVae

    config = load_config(path)
    try:
        model = VqVae(config.model, config.places)
        model.load_state_dict(load_file(find(path) / "model.safetensors"))
    except Exception as error:  # safetensors and torch each have errors of their own
        raise DataError(f"{path} holds no readable VQ-VAE: {one_line(error)}") from None
    return model.eval(), config
