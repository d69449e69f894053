"""What every subgoal generator offers."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

Info = dict[str, Tensor]


class SubgoalProposer(nn.Module, ABC):
    """A distribution over subgoals, given where one is and where one wants to be."""

    @abstractmethod
    def propose(self, observation: Tensor, goal: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Draw candidate subgoals.

        Args:
            observation: (B, S).
            goal: (B, G) final goals.
            count: K.

        Returns:
            (B, K, G) candidates and (B, K), the log-probability that the generator gives each.
        """

    @abstractmethod
    def loss(self, observation: Tensor, goal: Tensor, subgoal: Tensor) -> tuple[Tensor, Info]:
        """Return the loss on hindsight data (see ``pretrain.replay.Trajectories.subgoals``)."""
