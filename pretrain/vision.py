"""What the agent of an image task sees with: a VQ-VAE, which becomes a part of it."""

from __future__ import annotations

from pathlib import Path

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.cache import DatasetArrays, load_arrays
from eisp_data.tasks.images import IMAGE_TASKS
from pretrain.agent import Agent
from pretrain.config import AgentConfig, PretrainConfig
from vqvae import saved
from vqvae.latents import load_latent_arrays
from vqvae.model import VqVae


def load_vision(config: PretrainConfig) -> VqVae | None:
    """Return the VQ-VAE that an image task needs, None for tasks that are not seen in images."""
    path, wanted = config.vqvae.path, config.agent.vision
    if (path is None) != (wanted is None) or (wanted is None and config.agent.task in IMAGE_TASKS):
        raise ConfigError(
            f"{config.agent.task}: an image task, and no other, needs --vqvae.path, a run of "
            "eisp-vqvae train"
        )
    if path is None:
        return None
    model, found = saved.load(path)
    if found != wanted:
        raise DataError(f"{path} is not the VQ-VAE of the configuration: {found}, not {wanted}")
    return model


def check_resumed(agent: Agent, vision: VqVae | None, path: Path | None) -> None:
    """Raise DataError if a resumed agent sees with another VQ-VAE than its data are seen with."""
    if agent.vision and vision and agent.vision.fingerprint() != vision.fingerprint():
        raise DataError(f"{path} holds another codebook than the one that the run began with")


def load_seen(root: Path, config: AgentConfig, vision: VqVae | None) -> DatasetArrays:
    """Return a dataset's arrays as an agent sees them; DataError if it is of another task."""
    if vision is not None and config.vision is not None:
        arrays = load_latent_arrays(root, vision, config.vision)
    else:
        arrays = load_arrays(root)
    if arrays.spec.task != config.task:
        raise DataError(f"{root} is a dataset of {arrays.spec.task!r}, not of {config.task!r}")
    return arrays
