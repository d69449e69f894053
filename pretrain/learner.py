"""One update after another, on one core or on two.

In an update the critics, the actor and the generator take one step each, all from the same
parameters. Nothing in it depends on the order in which the gradients are computed, so that two
cores give bit for bit what one gives. On one of them run the critics, or in the updates that have
one the generator, which costs at least as much as actor and critics together; on the other all the
rest, and after it what the next update learns from is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from pretrain.agent import Agent
from pretrain.sac import Batch, Info

_CLIP = 100.0
"""Norm to which the generator's gradient is cut."""


@dataclass(frozen=True)
class Sample:
    """What one update learns from."""

    batch: Batch
    """For actor and critics."""
    hindsight: tuple[Tensor, Tensor, Tensor] | None
    """For the generator, see ``Trajectories.subgoals``; None leaves it as it is."""


class Learner:
    """Updates an agent.

    Args:
        agent: what learns.
        lr: of actor and critics.
        generator_lr: of the generator.
        threads: cores; with one, the two halves of the work run one after the other.
    """

    def __init__(self, agent: Agent, lr: float, generator_lr: float, threads: int) -> None:
        self._agent, self._sac = agent, agent.sac
        self._actor = torch.optim.Adam(agent.sac.actor.parameters(), lr=lr, fused=True)
        self._critic = torch.optim.Adam(agent.sac.critic.parameters(), lr=lr, fused=True)
        self._generator = torch.optim.Adam(agent.proposer.parameters(), lr=generator_lr, fused=True)
        # A GPU works through both halves in turn anyway.
        shared = threads > 1 and agent.bank.device.type == "cpu"
        self._beside = _second_thread() if shared else None

    @property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """What a checkpoint keeps."""
        return {"actor": self._actor, "critic": self._critic, "generator": self._generator}

    def set_lr(self, lr: float, generator_lr: float) -> None:
        """Change the learning rates."""
        for optimizer, value in (
            (self._actor, lr),
            (self._critic, lr),
            (self._generator, generator_lr),
        ):
            optimizer.param_groups[0]["lr"] = value

    def updates(self, samples: Iterator[Sample], cloning: float) -> Iterator[Info]:
        """Take one step for each sample, when its info is asked for.

        A sample is drawn before the step on the one before it is complete. Where the state of what
        draws them is saved, no more of them may be left.

        Args:
            samples: may not draw from torch's stream of random numbers.
            cloning: weight of the actor's cloning term.
        """
        drawn = self._next(samples)
        while drawn:
            batch, now, then, hindsight = drawn
            # All of the noise of actor and critics comes first: beside the generator, which draws
            # its own, nothing else may draw from the stream.
            noise, later_noise = torch.randn(2, *batch.action.shape, device=now.device)
            critic = partial(self._critic_gradient, batch, now, then, later_noise)
            if hindsight:
                beside = self._start(partial(self._generator_gradient, hindsight))
                info = critic()
            else:
                beside, info = self._start(critic), {}
            info |= self._actor_gradient(batch, now, noise, cloning)
            drawn = self._next(samples)
            info |= beside()
            for optimizer in (self._critic, self._actor):
                optimizer.step()
            if hindsight:
                self._generator.step()
            self._sac.follow()
            yield info

    def _next(self, samples: Iterator[Sample]) -> _Drawn | None:
        sample = next(samples, None)
        if sample is None:
            return None
        device = self._agent.bank.device
        batch = sample.batch.to(device)
        hindsight = [tensor.to(device) for tensor in sample.hindsight or ()]
        return batch, *self._sac.see(batch), hindsight

    def _start(self, work: Callable[[], Info]) -> Callable[[], Info]:
        if self._beside is not None:
            return self._beside.submit(work).result
        return work

    def _critic_gradient(self, batch: Batch, seen: Tensor, then: Tensor, noise: Tensor) -> Info:
        loss, info = self._sac.critic_loss(batch, seen, then, noise)
        _gradient(loss, self._critic)
        return info

    def _actor_gradient(self, batch: Batch, seen: Tensor, noise: Tensor, cloning: float) -> Info:
        loss, info = self._sac.actor_loss(batch, seen, noise, cloning)
        _gradient(loss, self._actor)
        return info

    def _generator_gradient(self, sample: list[Tensor]) -> Info:
        loss, info = self._agent.proposer.loss(*sample)
        _gradient(loss, self._generator)
        torch.nn.utils.clip_grad_norm_(self._agent.proposer.parameters(), _CLIP)
        return info


_Drawn = tuple[Batch, Tensor, Tensor, list[Tensor]]
"""A batch, its features before and after, and what the generator learns from, on the device."""


def _gradient(loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
    """Set the gradient of the optimizer's own parameters, and of no others."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward(inputs=optimizer.param_groups[0]["params"])


def threads_of_half(threads: int) -> int:
    """Return how many of the cores each half of an update has for its operations."""
    return max(1, threads // 2)


def _second_thread() -> ThreadPoolExecutor:
    # OpenMP counts its threads for each thread that uses it.
    return ThreadPoolExecutor(1, "learner", torch.set_num_threads, (torch.get_num_threads(),))
