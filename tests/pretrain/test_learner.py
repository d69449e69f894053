"""Updates: what they move, and that cores and devices do not change what is learned."""

from __future__ import annotations

import copy

import pytest
import torch
from learning_samples import linear_agent, make_agent, scene, small

from pretrain.agent import Agent
from pretrain.config import AgentConfig
from pretrain.layout import Layout
from pretrain.learner import Learner, Sample
from pretrain.sac import Batch


def sample(seed: int = 0, count: int = 32, generator: bool = False) -> Sample:
    """Return transitions of Stack, with or without hindsight subgoals."""
    (observation, goal), (after, subgoal) = (scene("stack", count, 2 * seed + i) for i in (0, 1))
    action = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed))
    ones = torch.ones(count)
    batch = Batch(observation, action, after, goal, -ones, ones, ones)
    return Sample(batch, (observation, goal, subgoal) if generator else None)


def learn(learner: Learner, samples: list[Sample], cloning: float = 1.0) -> None:
    """Take all of the updates."""
    for _ in learner.updates(iter(samples), cloning):
        pass


@pytest.fixture
def agent(stack_layout: Layout) -> Agent:
    return make_agent(small(AgentConfig("stack")), stack_layout)


@pytest.fixture
def stack_layout() -> Layout:
    from eisp_data.tasks.registry import TASKS

    return Layout.of(TASKS["stack"])


def parameters(agent: Agent) -> dict[str, torch.Tensor]:
    parts = {
        "actor": agent.sac.actor,
        "critic": agent.sac.critic,
        "target": agent.sac.target,
        "proposer": agent.proposer,
    }
    return {
        name: torch.cat([p.detach().flatten() for p in part.parameters()])
        for name, part in parts.items()
    }


@pytest.mark.parametrize("threads", [1, 2])
def test_an_update_moves_all_but_the_generator_which_waits_for_data(agent, threads):
    before, learner = parameters(agent), Learner(agent, 1e-3, 1e-3, threads)
    learn(learner, [sample()])
    after = parameters(agent)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"actor", "critic", "target"}
    learn(learner, [sample(generator=True)])
    assert not torch.equal(after["proposer"], agent_part := parameters(agent)["proposer"])
    assert agent_part.isfinite().all()


def test_two_cores_learn_bit_for_bit_what_one_learns(agent):
    ends = []
    for threads in (1, 2):
        learned = copy.deepcopy(agent)
        samples = [sample(update, generator=update % 3 == 0) for update in range(12)]
        torch.manual_seed(0)
        learn(Learner(learned, 1e-3, 1e-3, threads), samples, 20.0)
        ends.append(parameters(learned))
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name]), name


def test_actor_and_critics_step_from_the_same_parameters(agent):
    """The actor's gradient is that of the critics as they were before the update."""
    given = sample()
    batch = given.batch
    noise = torch.Generator().manual_seed(7)
    now, _ = torch.randn(2, *batch.action.shape, generator=noise)
    loss, _ = agent.sac.actor_loss(batch, agent.sac.see(batch)[0], now, 1.0)
    weights = list(agent.sac.actor.parameters())
    expected = [gradient.clone() for gradient in torch.autograd.grad(loss, weights)]
    torch.manual_seed(7)
    learn(Learner(agent, 1e-3, 1e-3, 1), [given])
    for weight, gradient in zip(weights, expected, strict=True):
        torch.testing.assert_close(weight.grad, gradient)


def test_an_error_in_the_other_half_is_raised(agent):
    given = sample()
    given.batch.reward = given.batch.reward[:-1]
    with pytest.raises(RuntimeError):
        learn(Learner(agent, 1e-3, 1e-3, 2), [given])


def test_drawing_ahead_changes_nothing(agent):
    """All at once or one by one: what is saved after an update does not know of the next."""
    samples = [sample(update, generator=update == 1) for update in range(4)]
    ends = []
    for portions in ([samples], [[each] for each in samples]):
        learned = copy.deepcopy(agent)
        learner = Learner(learned, 1e-3, 1e-3, 2)
        torch.manual_seed(0)
        for portion in portions:
            learn(learner, portion)
        ends.append(parameters(learned))
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name]), name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_learns_what_a_processor_learns():
    agents = [linear_agent().to(device) for device in ("cpu", "cuda")]
    observation, after, goal = torch.randn(3, 64, 2)
    ones, noise = torch.ones(64), torch.randn(64, 1)
    batch = Batch(observation, torch.rand(64, 1), after, goal, -ones, ones, ones)
    weights = []
    for agent, device in zip(agents, ("cpu", "cuda"), strict=True):
        optimizer = torch.optim.Adam(agent.sac.critic.parameters(), lr=1e-2)
        for _ in range(5):
            optimizer.zero_grad()
            there = batch.to(torch.device(device))
            agent.sac.critic_loss(there, *agent.sac.see(there), noise.to(device))[0].backward()
            optimizer.step()
        weights.append(agent.sac.critic.body.weights[0].detach().cpu())
    torch.testing.assert_close(*weights, atol=1e-4, rtol=1e-4)
