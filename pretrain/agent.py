"""All that is learned and how it is put together: features, SAC, generator, a bank of goals."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from eisp_data.config import from_plain, to_plain
from eisp_data.errors import ConfigError, DataError
from eisp_data.runs.disk import writing
from eisp_data.storage.files import one_line, replace_atomically, write_json
from pretrain.config import AgentConfig
from pretrain.features import ObjectFeatures, PlainFeatures
from pretrain.layout import Layout
from pretrain.proposers.hybrid import Hybrid
from pretrain.proposers.movers import Movers
from pretrain.proposers.pictured import PicturedMovers
from pretrain.proposers.proposer import SubgoalProposer
from pretrain.sac import Sac
from vqvae.model import VqVae

BANK = 4096
"""Achieved goals of the dataset that an agent carries with it, for random subgoals."""


class Agent(nn.Module):
    """Low-level policy and subgoal generator.

    Args:
        config: which parts.
        layout: the environment's.
        moments: of the dataset, see ``pretrain.replay.Trajectories.moments``.
        bank: (BANK, G) achieved goals.
    """

    bank: Tensor

    def __init__(
        self, config: AgentConfig, layout: Layout, moments: dict[str, Tensor], bank: Tensor
    ) -> None:
        super().__init__()
        if not layout.objects and "objects" in (config.features, _NEEDS.get(config.generator)):
            raise ConfigError(
                f"{config.task}: observation and goal are not made of objects as the simulated "
                "tasks' are; choose --agent.features plain --agent.generator hybrid"
            )
        self.config, self.layout = config, layout
        features: nn.Module = (
            ObjectFeatures(layout, moments)
            if config.features == "objects"
            else PlainFeatures(layout, moments)
        )
        self.sac = Sac(features, layout.action_dim, config.sac)
        self.proposer = _proposer(config, layout, moments)
        self.register_buffer("bank", bank)
        vision = config.vision
        self.vision = VqVae(vision.model, vision.places).requires_grad_(False) if vision else None

    def save(self, folder: Path) -> None:
        """Write ``config.json`` and ``model.safetensors``, each whole or not at all."""
        # Modules share the feature buffers; a file must not.
        tensors = {name: value.clone().contiguous() for name, value in self.state_dict().items()}
        plain = {"agent": to_plain(self.config), "layout": to_plain(self.layout)}
        with writing(folder):
            replace_atomically(folder / "model.safetensors", lambda path: save_file(tensors, path))
            write_json(folder / "config.json", plain)

    @classmethod
    def load(cls, folder: Path, device: str = "cpu") -> Agent:
        """Read what ``save`` wrote; DataError if it cannot be read."""
        for name in ("config.json", "model.safetensors"):
            if not (folder / name).is_file():
                raise DataError(f"{folder} holds no policy: {name} is missing")
        try:
            plain = json.loads((folder / "config.json").read_text())
            tensors = load_file(folder / "model.safetensors")
            layout = from_plain(Layout, plain["layout"])
            config = from_plain(AgentConfig, plain["agent"])
            agent = cls(config, layout, empty_moments(layout), torch.zeros_like(tensors["bank"]))
            agent.load_state_dict(tensors)
        except Exception as error:  # json, safetensors and torch each have errors of their own
            raise DataError(f"{folder} holds no readable policy: {one_line(error)}") from None
        return agent.to(device)


_NEEDS = {"movers": "objects"}


def _proposer(config: AgentConfig, layout: Layout, moments: dict[str, Tensor]) -> SubgoalProposer:
    if config.generator == "hybrid":
        return Hybrid(layout, moments, config.hybrid)
    if layout.latent_dim:
        return PicturedMovers(layout, moments, config.movers)
    return Movers(layout, config.movers)


def empty_moments(layout: Layout) -> dict[str, Tensor]:
    """Return moments that change nothing: means zero, deviations one."""
    sizes = {"observation": layout.observation_dim, "goal": layout.goal_dim}
    return {f"{name}_mean": torch.zeros(size) for name, size in sizes.items()} | {
        f"{name}_std": torch.ones(size) for name, size in sizes.items()
    }
