"""The paper's Hybrid Subgoal Generator: a CVAE whose latent space is the subgoal space.

The explicit encoder psi(subgoal | s, g) is a Laplace with two linear heads on a perceptron
(section "Implementation Details"); the implicit decoder psi'(g | s, subgoal) mirrors it. Goals are
standardised with the moments of the dataset, so that the standard normal prior means something.

L = L_HY + beta L_HS (Eq. 14). The text prints L_HY as an objective to be maximised (Eq. 9); here
it is the negative ELBO, to be minimised.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pretrain.config import HybridConfig
from pretrain.layout import Layout
from pretrain.networks import MLP
from pretrain.proposers import laplace
from pretrain.proposers.proposer import Info, SubgoalProposer

_LEAST_SCALE = 1e-3


class Hybrid(SubgoalProposer):
    """Explicit encoder and implicit decoder; see the module.

    Args:
        layout: the environment's.
        moments: ``observation_mean`` (S,), ``observation_std`` (S,), ``goal_mean`` (G,) and
            ``goal_std`` (G,) of the dataset.
        config: the hyperparameters.
    """

    observation_mean: Tensor
    observation_std: Tensor
    goal_mean: Tensor
    goal_std: Tensor

    def __init__(self, layout: Layout, moments: dict[str, Tensor], config: HybridConfig) -> None:
        super().__init__()
        self.config = config
        for name, value in moments.items():
            self.register_buffer(name, value.clone())
        inputs = layout.observation_dim + layout.goal_dim
        *body, last = config.layers
        self.encoder = nn.Sequential(MLP(inputs, body, last), nn.ReLU())
        self.mean = nn.Linear(last, layout.goal_dim)
        self.scale = nn.Linear(last, layout.goal_dim)
        self.decoder = MLP(inputs, config.layers, layout.goal_dim)

    def _state(self, observation: Tensor) -> Tensor:
        return (observation - self.observation_mean) / self.observation_std

    def _goal(self, goal: Tensor) -> Tensor:
        return (goal - self.goal_mean) / self.goal_std

    def encode(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and scale (B, G) of the standardised subgoal."""
        hidden = self.encoder(torch.cat([self._state(observation), self._goal(goal)], -1))
        return self.mean(hidden), nn.functional.softplus(self.scale(hidden)) + _LEAST_SCALE

    @torch.no_grad()
    def propose(self, observation: Tensor, goal: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Draw candidates from the encoder; a single one is its mean."""
        mean, scale = (x[:, None].expand(-1, count, -1) for x in self.encode(observation, goal))
        drawn = mean if count == 1 else laplace.sample(mean, scale)
        return drawn * self.goal_std + self.goal_mean, laplace.log_prob(drawn, mean, scale)

    def loss(self, observation: Tensor, goal: Tensor, subgoal: Tensor) -> tuple[Tensor, Info]:
        """Return L_HY + beta L_HS."""
        mean, scale = self.encode(observation, goal)
        drawn = laplace.sample(mean, scale)
        guess = self.decoder(torch.cat([self._state(observation), drawn], -1))
        reconstruction = 0.5 * (guess - self._goal(goal)).square().sum(-1)
        divergence = laplace.kl_to_standard_normal(mean, scale)
        likelihood = laplace.log_prob(self._goal(subgoal), mean, scale)
        loss = (reconstruction + divergence - self.config.beta * likelihood).mean()
        return loss, {
            "log_likelihood": likelihood.detach().mean(),
            "reconstruction_error": reconstruction.detach().mean(),
            "divergence": divergence.detach().mean(),
        }
