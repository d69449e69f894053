"""VQ-VAEs on the disk."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors.torch import load_file, save_file

from eisp_data.config import from_plain, to_plain
from eisp_data.errors import DataError
from eisp_data.runs.checkpoint import MODEL
from eisp_data.storage.files import one_line, replace_atomically, write_json
from vqvae.config import VqVaeConfig
from vqvae.model import VqVae


def save(model: VqVae, task: str, camera: str, folder: Path) -> None:
    """Write ``config.json`` and ``model.safetensors``, each whole or not at all.

    Args:
        model: the VQ-VAE.
        task: whose images it was trained on.
        camera: which of its cameras saw them.
        folder: where to.
    """
    tensors = {name: value.cpu().contiguous() for name, value in model.state_dict().items()}
    replace_atomically(folder / "model.safetensors", lambda path: save_file(tensors, path))
    plain = {"vqvae": to_plain(model.config), "task": task, "camera": camera}
    write_json(folder / "config.json", plain)


def find(path: Path) -> Path:
    """Return the folder of the VQ-VAE for a path that names it, its checkpoint or its run."""
    for folder in (path, path / MODEL, path / "checkpoints" / "last" / MODEL):
        if (folder / "model.safetensors").exists():
            return folder
    raise DataError(f"{path} holds no VQ-VAE; give a run of eisp-vqvae train")


def load(path: Path) -> tuple[VqVae, str, str]:
    """Return a VQ-VAE, its task and its camera; DataError if it cannot be read."""
    folder = find(path)
    try:
        plain = json.loads((folder / "config.json").read_text())
        if "vqvae" not in plain:
            raise DataError(f"{path} holds a policy, not a VQ-VAE")
        model = VqVae(from_plain(VqVaeConfig, plain["vqvae"]))
        model.load_state_dict(load_file(folder / "model.safetensors"))
        return model.eval(), str(plain["task"]), str(plain["camera"])
    except DataError:
        raise
    except Exception as error:  # json, safetensors and torch each have errors of their own
        raise DataError(f"{path} holds no readable VQ-VAE: {one_line(error)}") from None
