"""Which of the candidates becomes the subgoal.

``value`` is the paper's Eq. (11): the candidate of highest value. V alone is highest for a subgoal
that is already reached, which is what the paper's failure analysis finds (its Fig. "failed").

``likely`` first drops what leads nowhere: candidates that are where one is already, those that the
generator gives less than a tenth of the weight of its best, and above all those that have been
pursued in vain twice. What is left are different ways on (which block next), and of these it takes
the one of highest

    log w + V / 10,

w its weight: V is minus the steps to it, about, and ten more of them count as e times less likely.
By V alone the nearest is taken, be it likely or not: a drawer is shut again with nothing in it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pretrain.agent import Agent

_LEAST_WEIGHT = math.log(0.1)
_STEPS_PER_NAT = 10.0
_TRIES = 2


def select(
    agent: Agent,
    observation: Tensor,
    achieved_goal: Tensor,
    candidates: Tensor,
    likelihood: Tensor,
    idle: Tensor,
    failed: Tensor,
) -> Tensor:
    """Choose one candidate a row.

    Args:
        agent: gives V and the rule.
        observation: (B, S).
        achieved_goal: (B, G) what is already so.
        candidates: (B, K, G).
        likelihood: (B, K) log-probabilities that the generator gave them.
        idle: (B,) bool, where the best has been what is so already for too long: there a tenth
            of the best of the others will do.
        failed: (B, M, G) subgoals that were pursued in vain.

    Returns:
        (B, G)
    """
    batch, count, _ = candidates.shape
    if count == 1:
        return candidates[:, 0]
    repeated = observation[:, None].expand(-1, count, -1).flatten(0, 1)
    score = agent.sac.value(repeated, candidates.flatten(0, 1)).view(batch, count)
    if agent.config.subgoals.selector == "likely":
        way = agent.layout.apart(candidates, achieved_goal[:, None]).norm(dim=-1)
        trivial = way <= agent.config.subgoals.reached_m
        apart = agent.layout.apart(candidates[:, :, None], failed[:, None]).norm(dim=-1)
        vain = (apart <= agent.config.subgoals.final_m).sum(-1) >= _TRIES
        compared = likelihood - _DROPPED * (vain | (trivial & idle[:, None]))
        unlikely = likelihood < compared.amax(1, keepdim=True) + _LEAST_WEIGHT
        dropped = trivial.float() + unlikely.float() + 2.0 * vain
        score = likelihood + score / _STEPS_PER_NAT - _DROPPED * dropped
    return candidates[torch.arange(batch), score.argmax(1)]


_DROPPED = 1e4
"""More than any difference of scores: dropped candidates come last."""
