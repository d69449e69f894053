"""Which of the candidates becomes the subgoal."""

from __future__ import annotations

import torch
from torch import Tensor

from pretrain.agent import Agent


def select(
    agent: Agent,
    observation: Tensor,
    goal: Tensor,
    candidates: Tensor,
    likelihood: Tensor,
) -> Tensor:
    """Choose one candidate a row.

    Args:
        agent: gives V and the rule.
        observation: (B, S).
        goal: (B, G) final goals.
        candidates: (B, K, G).
        likelihood: (B, K) log-probabilities that the generator gave them.

    Returns:
        (B, G)
    """
    batch, count, _ = candidates.shape
    if count == 1:
        return candidates[:, 0]
    repeated = observation[:, None].expand(-1, count, -1).flatten(0, 1)
    value = agent.sac.value(repeated, candidates.flatten(0, 1)).view(batch, count)
    if agent.config.subgoals.selector == "route":
        value = value + _PRIOR_WEIGHT * likelihood
    return candidates[torch.arange(batch), value.argmax(1)]


_PRIOR_WEIGHT = 5.0
