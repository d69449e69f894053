"""The generator of image tasks: who moves next and where to, and what that will look like.

Places are proposed from places, as for states. A perceptron imagines the latent of an image in
which the objects are there, from what is seen now; decoded, it is a picture of the subgoal.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pretrain.config import MoversConfig
from pretrain.layout import Layout
from pretrain.networks import MLP
from pretrain.proposers.movers import SCALE, Movers
from pretrain.proposers.proposer import Info

_WIDTH = 256


class PicturedMovers(Movers):
    """Mixture over movers, with latents; see the module.

    Args:
        layout: the environment's.
        moments: of the dataset; only those of the latent are used.
        config: the hyperparameters.
    """

    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, layout: Layout, moments: dict[str, Tensor], config: MoversConfig) -> None:
        super().__init__(layout, config)
        self._latent_dim = layout.latent_dim
        for name in ("mean", "std"):
            latent = moments[f"goal_{name}"][-layout.latent_dim :]
            self.register_buffer(f"latent_{name}", latent.clone())
        inputs = layout.robot_dim + layout.latent_dim + 2 * layout.places_dim
        self.picture = MLP(inputs, (_WIDTH,) * 2, layout.latent_dim)

    def propose(self, observation: Tensor, goal: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Draw candidates with their latents."""
        drawn, log_prob = super().propose(observation, goal, count)
        with torch.no_grad():
            places = drawn[..., : self._layout.places_dim]
            repeated = observation[:, None].expand(-1, drawn.shape[1], -1)
            latent = self._imagine(repeated, places) * self.latent_std + self.latent_mean
        return torch.cat([places, latent], -1), log_prob

    def loss(self, observation: Tensor, goal: Tensor, subgoal: Tensor) -> tuple[Tensor, Info]:
        """Return the loss of ``Movers`` and the error of the standardised latent."""
        total, info = super().loss(observation, goal, subgoal)
        places, latent = subgoal.split([self._layout.places_dim, self._latent_dim], -1)
        true = (latent - self.latent_mean) / self.latent_std
        error = nn.functional.mse_loss(self._imagine(observation, places), true)
        return total + error, info | {"picture_error": error.detach()}

    def _imagine(self, observation: Tensor, places: Tensor) -> Tensor:
        """Return the standardised latents (..., L) where (..., P) places are as wanted."""
        robot = observation[..., : self._layout.robot_dim]
        latent = (observation[..., -self._latent_dim :] - self.latent_mean) / self.latent_std
        here = observation[..., self._places].flatten(-2)
        return self.picture(torch.cat([robot, latent, here * SCALE, (places - here) * SCALE], -1))
