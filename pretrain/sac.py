"""Soft Actor-Critic on goals (Haarnoja et al. 2018), offline and online.

Fixed temperature, as in the paper. Where it matters offline, two terms are added: values are
clipped to the range that the reward of Eq. (1) allows, and the actor is drawn to the
demonstrations' actions where the goal is one that the demonstration went on to reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from pretrain.config import SacConfig
from pretrain.networks import MLP, EnsembleMLP

Info = dict[str, Tensor]

_LOG_STD_MIN, _LOG_STD_MAX = -5.0, 1.0


@dataclass
class Batch:
    """B transitions with their goals."""

    observation: Tensor
    """(B, S)"""
    action: Tensor
    """(B, A)"""
    next_observation: Tensor
    """(B, S)"""
    goal: Tensor
    """(B, G)"""
    reward: Tensor
    """(B,) Eq. (1) for that goal, 0 or -1."""
    clone: Tensor
    """(B,) 1 where the trajectory went on to bring its objects to this goal, else 0."""
    demonstrated: Tensor
    """(B,) 1 where the trajectory is a demonstration, else 0."""

    @classmethod
    def joined(cls, parts: Sequence[Batch]) -> Batch:
        """Return one batch of all the parts."""
        return cls(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device."""
        return Batch(*(getattr(self, f.name).to(device) for f in fields(self)))


class Actor(nn.Module):
    """A Gaussian squashed by tanh."""

    def __init__(self, size: int, layers: Sequence[int], actions: int) -> None:
        super().__init__()
        self.body = MLP(size, layers, 2 * actions)

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation, each (B, A), before the tanh."""
        mean, log_std = self.body(seen).chunk(2, -1)
        return mean, log_std.clamp(_LOG_STD_MIN, _LOG_STD_MAX)

    def sample(self, seen: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return a sampled action (B, A), its log-probability (B,) and the mean action (B, A).

        Args:
            seen: (B, F) features.
            noise: (B, A) standard normal; drawn if left out.
        """
        mean, log_std = self(seen)
        noise = torch.randn_like(mean) if noise is None else noise
        before = mean + noise * log_std.exp()
        # log N(before) - log |d tanh / d before|, the latter in its stable form.
        log_prob = -0.5 * noise.square() - log_std - 0.9189385332046727
        log_prob -= 2 * (0.6931471805599453 - before - nn.functional.softplus(-2 * before))
        return before.tanh(), log_prob.sum(-1), mean.tanh()


class Critic(nn.Module):
    """Twin action values."""

    def __init__(self, size: int, layers: Sequence[int], actions: int, layer_norm: bool) -> None:
        super().__init__()
        self.body = EnsembleMLP(2, size + actions, layers, layer_norm=layer_norm)

    def forward(self, seen: Tensor, action: Tensor) -> Tensor:
        """Return (2, B) values of (B, F) features and (B, A) actions."""
        return self.body(torch.cat([seen, action], -1))


class Sac(nn.Module):
    """Actor, twin critics and their target.

    Args:
        features: a module with ``size`` and ``forward(observation, goal)``, without parameters.
        actions: A.
        config: the hyperparameters.
    """

    def __init__(self, features: nn.Module, actions: int, config: SacConfig) -> None:
        super().__init__()
        size = features.size
        assert isinstance(size, int)
        self.config, self.features = config, features
        self.actor = Actor(size, config.layers, actions)
        self.critic = Critic(size, config.layers, actions, config.layer_norm)
        self.target = Critic(size, config.layers, actions, config.layer_norm)
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)

    @property
    def lowest_value(self) -> float:
        """The value of never reaching the goal."""
        return -1.0 / (1.0 - self.config.gamma)

    @torch.no_grad()
    def act(self, observation: Tensor, goal: Tensor, noise: float = 0.0) -> Tensor:
        """Return (B, A) actions: the mean, or with noise 1 a sample, or something between."""
        mean, log_std = self.actor(self.features(observation, goal))
        if noise:
            mean = mean + noise * log_std.exp() * torch.randn_like(mean)
        action: Tensor = mean.tanh()
        return action

    @torch.no_grad()
    def value(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return V(s, g) = E_a [min Q(s, g, a) - alpha log pi(a | s, g)], one sample, (B,)."""
        seen = self.features(observation, goal)
        action, log_prob, _ = self.actor.sample(seen)
        return self.critic(seen, action).amin(0) - self.config.alpha * log_prob

    def see(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the features (B, F) of the transitions' observations and of those that follow."""
        both = torch.cat([batch.observation, batch.next_observation])
        now, then = self.features(both, batch.goal.repeat(2, 1)).chunk(2)
        return now, then

    def critic_loss(
        self, batch: Batch, seen: Tensor, then: Tensor, noise: Tensor
    ) -> tuple[Tensor, Info]:
        """Return the mean squared Bellman error of both critics.

        Args:
            batch: of transitions.
            seen: (B, F) their features before.
            then: (B, F) their features after.
            noise: (B, A) standard normal, for the actions that follow.
        """
        with torch.no_grad():
            action, log_prob, _ = self.actor.sample(then, noise)
            following = self.target(then, action).amin(0)
            following = following - self.config.alpha * log_prob
            target = batch.reward + self.config.gamma * following
            if self.config.clip_targets:
                target = target.clamp(self.lowest_value, 0.0)
        value = self.critic(seen, batch.action)
        loss = (value - target).square().mean()
        return loss, {"critic_loss": loss.detach(), "value": value.detach().mean()}

    def actor_loss(
        self, batch: Batch, seen: Tensor, noise: Tensor, cloning: float
    ) -> tuple[Tensor, Info]:
        """Return E [alpha log pi - min Q] plus the cloning term.

        Demonstrated actions are cloned as they are, the policy's own only where they are worth
        more than what it would do now (Nair et al. 2018, "Q-filter").

        Args:
            batch: of transitions.
            seen: (B, F) their features before.
            noise: (B, A) standard normal, for the sampled actions.
            cloning: weight of the cloning term.
        """
        action, log_prob, mean = self.actor.sample(seen, noise)
        value = self.critic(seen, action).amin(0)
        loss = (self.config.alpha * log_prob - value).mean()
        info = {"actor_loss": loss.detach(), "entropy": -log_prob.detach().mean()}
        if cloning:
            chosen = batch.clone
            if not batch.demonstrated.all():
                with torch.no_grad():
                    shown = self.critic(seen, batch.action).amin(0)
                chosen = chosen * torch.maximum(batch.demonstrated, (shown > value).float())
            error = (mean - batch.action).square().sum(-1)
            clone = (chosen * error).sum() / chosen.sum().clamp(min=1.0)
            loss = loss + cloning * clone
            info["cloning_error"] = clone.detach()
        return loss, info

    def follow(self) -> None:
        """Let the target critic follow by ``tau``."""
        with torch.no_grad():
            targets: list[Tensor] = list(self.target.body.parameters())
            sources: list[Tensor] = list(self.critic.body.parameters())
            torch._foreach_lerp_(targets, sources, self.config.tau)
