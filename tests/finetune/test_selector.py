"""Which candidate becomes the subgoal."""

from dataclasses import replace

import pytest
import torch
from learning_samples import linear_agent

from finetune.selector import select
from pretrain.agent import Agent
from pretrain.config import SubgoalConfig

HERE = torch.zeros(1, 2)
EQUAL = torch.zeros(1, 3)
NEVER = torch.full((1, 2, 2), torch.inf)
BUSY, IDLE = torch.tensor([False]), torch.tensor([True])


def agent_that_values(selector: str, weight: tuple[float, float], **changes: float) -> Agent:
    """Return an agent to whom a subgoal is worth the weighted sum of its coordinates."""
    agent = linear_agent(subgoals=SubgoalConfig(selector=selector, reached_m=0.02, **changes))
    agent.sac.critic.body.weights[0].data[:, 2:4, 0] = torch.tensor(weight)
    return agent


def choose(
    agent: Agent,
    candidates: list[list[float]],
    likelihood: torch.Tensor = EQUAL,
    idle: torch.Tensor = BUSY,
    failed: torch.Tensor = NEVER,
):
    found = select(agent, HERE, HERE, torch.tensor([candidates]), likelihood, idle, failed)
    return found[0].tolist()


@pytest.mark.parametrize("weight", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)])
def test_the_published_rule_takes_the_candidate_of_highest_value(weight):
    agent = agent_that_values("value", weight)
    torch.manual_seed(0)
    candidates = torch.rand(50, 6, 2)
    here = torch.zeros(50, 2)
    found = select(agent, here, here, candidates, torch.zeros(50, 6), BUSY, NEVER)
    best = (candidates @ torch.tensor(weight)).argmax(1)
    assert torch.equal(found, candidates[torch.arange(50), best])


def test_the_published_rule_is_blind_to_likelihood_and_to_what_is_reached():
    agent = agent_that_values("value", (1.0, 0.0))
    unlikely = torch.tensor([[-9.0, 0.0, 0.0]])
    assert choose(agent, [[0.01, 0.0], [-0.5, 0.0], [-0.9, 0.0]], unlikely) == [
        pytest.approx(0.01),
        0.0,
    ]


def test_candidates_that_are_reached_already_are_dropped():
    agent = agent_that_values("likely", (-1.0, 0.0))
    assert choose(agent, [[0.01, 0.0], [0.5, 0.0], [0.9, 0.0]]) == [0.5, 0.0]


def test_candidates_far_less_likely_than_the_best_are_dropped():
    agent = agent_that_values("likely", (100.0, 0.0))
    candidates = [[0.5, 0.0], [0.75, 0.0], [1.0, 0.0]]
    likelihood = torch.tensor([[0.5, 0.4, 0.01]]).log()
    assert choose(agent, candidates, likelihood) == [0.75, 0.0]
    assert choose(agent, candidates, torch.tensor([[0.5, 0.4, 0.3]]).log()) == [1.0, 0.0]


def test_what_is_so_already_and_far_likelier_is_dropped_when_nothing_else_was_chosen_for_long():
    agent = agent_that_values("likely", (0.0, 0.0))
    candidates = [[0.01, 0.0], [0.5, 0.0], [0.9, 0.0]]
    likelihood = torch.tensor([[0.97, 0.02, 0.001]]).log()
    assert choose(agent, candidates, likelihood) == [pytest.approx(0.01), 0.0]
    assert choose(agent, candidates, likelihood, IDLE) == [0.5, 0.0]


def test_what_was_pursued_in_vain_twice_gives_way_to_what_is_far_less_likely():
    agent = agent_that_values("likely", (0.0, 0.0))
    candidates = [[0.5, 0.0], [0.9, 0.0]]
    likelihood = torch.tensor([[0.97, 0.03]]).log()
    once = torch.tensor([[[0.5, 0.0], [torch.inf, torch.inf]]])
    twice = torch.tensor([[[0.5, 0.0], [0.52, 0.0]]])
    assert choose(agent, candidates, likelihood, failed=once) == [0.5, 0.0]
    assert choose(agent, candidates, likelihood, failed=twice)[0] == pytest.approx(0.9)
    # Better what was pursued in vain than nothing.
    assert choose(agent, candidates[:1] * 2, likelihood, failed=twice) == [0.5, 0.0]


@pytest.mark.parametrize("steps", [5.0, 15.0])
def test_ten_steps_weigh_as_much_as_a_factor_e_of_likelihood(steps):
    agent = agent_that_values("likely", (-steps, 0.0))
    near_or_likely = choose(
        agent, [[1.0, 0.0], [2.0, 0.0]], torch.tensor([[1.0, torch.e]]).log() - 2
    )
    assert near_or_likely == ([2.0, 0.0] if steps < 10 else [1.0, 0.0])


def test_where_all_are_dropped_one_is_chosen_all_the_same():
    agent = agent_that_values("likely", (1.0, 0.0))
    candidates = [[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]]
    assert choose(agent, candidates) in [[pytest.approx(c) for c in each] for each in candidates]


def test_a_single_candidate_is_chosen_without_asking():
    agent = agent_that_values("likely", (1.0, 0.0))
    assert choose(agent, [[0.0, 0.0]], torch.zeros(1, 1)) == [0.0, 0.0]


def test_every_row_chooses_for_itself():
    agent = agent_that_values("value", (1.0, 0.0))
    candidates = torch.tensor([[[0.2, 0.0], [0.4, 0.0]], [[0.9, 0.0], [0.1, 0.0]]])
    here = HERE.expand(2, 2)
    found = select(agent, here, here, candidates, torch.zeros(2, 2), BUSY, NEVER)
    assert found[:, 0].tolist() == pytest.approx([0.4, 0.9])


def test_the_rule_is_the_agents_setting():
    agent = agent_that_values("value", (-1.0, 0.0))
    candidates = [[0.01, 0.0], [0.5, 0.0], [0.9, 0.0]]
    assert choose(agent, candidates)[0] == pytest.approx(0.01)
    subgoals = replace(agent.config.subgoals, selector="likely")
    agent.config = replace(agent.config, subgoals=subgoals)
    assert choose(agent, candidates)[0] == 0.5
