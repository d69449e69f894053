"""Subgoal generators: what each promises, and what is its own."""

import itertools
from dataclasses import replace

import pytest
import torch
from learning_samples import make_agent, scene, small
from torch.distributions import Laplace

from eisp_data.tasks.registry import TASKS
from pretrain.agent import empty_moments
from pretrain.config import AgentConfig, HybridConfig, MoversConfig
from pretrain.layout import Layout
from pretrain.proposers.hybrid import Hybrid
from pretrain.proposers.movers import Movers
from pretrain.proposers.pictured import PicturedMovers

GENERATORS = ("movers", "hybrid")
LAYOUTS = {name: Layout.of(task) for name, task in TASKS.items()}


def generator(kind: str, task: str, **changes: object):
    config = small(AgentConfig(task, generator=kind))
    return make_agent(replace(config, **changes), LAYOUTS[task]).proposer


def renamed(layout: Layout, order: tuple[int, ...], observation, goal):
    """Return the scene with object ``order[i]`` called object i."""
    seen, wanted = observation.clone(), goal.clone()
    for i, source in enumerate(order):
        to, of = layout.objects[i], layout.objects[source]
        seen[:, to.observation : to.observation + 15] = observation[
            :, of.observation : of.observation + 15
        ]
        wanted[:, to.goal : to.goal + 3] = goal[:, of.goal : of.goal + 3]
    return seen, wanted


@pytest.mark.parametrize("kind", GENERATORS)
@pytest.mark.parametrize("task", TASKS)
def test_candidates_have_their_shapes_and_are_finite(kind, task):
    proposer = generator(kind, task)
    observation, goal = scene(task, 5)
    for count in (1, 2, len(LAYOUTS[task].objects), 9):
        candidates, log_prob = proposer.propose(observation, goal, count)
        assert candidates.shape == (5, count, LAYOUTS[task].goal_dim)
        assert log_prob.shape == (5, count)
        assert candidates.isfinite().all() and log_prob.isfinite().all()
        assert not candidates.requires_grad


@pytest.mark.parametrize("kind", GENERATORS)
@pytest.mark.parametrize("task", TASKS)
def test_every_weight_learns_from_the_loss(kind, task):
    proposer = generator(kind, task)
    observation, goal = scene(task, 32)
    _, subgoal = scene(task, 32, seed=1)
    loss, info = proposer.loss(observation, goal, subgoal)
    loss.backward()
    assert loss.isfinite() and all(value.isfinite() for value in info.values())
    assert not any(value.requires_grad for value in info.values())
    for name, parameter in proposer.named_parameters():
        assert parameter.grad is not None and (parameter.grad != 0).any(), name


@pytest.mark.parametrize("kind", GENERATORS)
def test_a_generator_learns_which_object_moves_first_and_where_to(kind):
    torch.manual_seed(0)
    layout, moments = LAYOUTS["stack"], empty_moments(LAYOUTS["stack"])
    observation, goal = scene("stack", 64)
    place = torch.stack([observation[:, o.observation : o.observation + 3] for o in layout.objects])
    moments["goal_mean"], moments["goal_std"] = goal.mean(0), goal.std(0)
    # Object 0 goes to its goal, the others stay.
    subgoal = torch.cat([goal[:, :3], place[1], place[2]], 1)
    proposer = (
        Movers(layout, MoversConfig(width=16))
        if kind == "movers"
        else Hybrid(layout, moments, HybridConfig(layers=(64,), beta=30.0))
    )
    optimizer = torch.optim.Adam(proposer.parameters(), lr=5e-3)

    def missed() -> float:
        proposed = proposer.propose(observation, goal, 1)[0][:, 0]
        return (proposed - subgoal).norm(dim=1).mean().item()

    before = missed()
    for _ in range(80):
        optimizer.zero_grad()
        proposer.loss(observation, goal, subgoal)[0].backward()
        optimizer.step()
    assert missed() < before / 2


@pytest.mark.parametrize("task", ["stack", "push4"])
def test_movers_treat_objects_of_a_kind_alike(task):
    proposer, layout = generator("movers", task), LAYOUTS[task]
    observation, goal = scene(task, 16)
    log_weight, mean, scale = proposer.components(observation, goal)
    for order in list(itertools.permutations(range(len(layout.objects))))[1::5]:
        there = list(order)
        other = proposer.components(*renamed(layout, order, observation, goal))
        close = {"atol": 1e-4, "rtol": 1e-4}
        modes = proposer.config.modes
        which = [i * modes + mode for i in there for mode in range(modes)]
        torch.testing.assert_close(other[0], log_weight[:, which], **close)
        torch.testing.assert_close(other[1], mean[:, which][:, :, there], **close)
        torch.testing.assert_close(other[2], scale[:, which][:, :, there], **close)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("count", [1, 2, 12])
def test_the_first_candidates_are_the_means_of_the_components_likeliest_first(task, count):
    proposer, layout = generator("movers", task), LAYOUTS[task]
    observation, goal = scene(task, 6)
    candidates, log_prob = proposer.propose(observation, goal, count)
    log_weight, mean, _ = proposer.components(observation, goal)
    torch.testing.assert_close(log_weight.logsumexp(1), torch.zeros(6), atol=1e-5, rtol=0)
    first = min(count, len(layout.objects))
    best = log_weight.topk(first, 1)
    torch.testing.assert_close(log_prob[:, :first], best.values)
    for row, which in itertools.product(range(6), range(first)):
        for i, item in enumerate(layout.objects):
            place = observation[row, item.observation : item.observation + 3]
            expected = place + mean[row, best.indices[row, which], i] / 10
            found = candidates[row, which, item.goal : item.goal + 3]
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_further_candidates_of_movers_scatter_as_the_temperature_says():
    observation, goal = scene("stack", 4)
    spread = []
    for temperature in (0.0, 0.3, 1.0):
        proposer = generator("movers", "stack", movers=MoversConfig(8, temperature=temperature))
        torch.manual_seed(0)
        components = proposer.components(observation, goal)[0].shape[1]
        candidates, log_prob = proposer.propose(observation, goal, components + 200)
        means, drawn = candidates[:, :components], candidates[:, components:]
        apart = (drawn[:, :, None] - means[:, None]).norm(dim=-1).amin(-1)
        spread.append(apart.mean().item())
        assert (log_prob[:, components:, None] == log_prob[:, None, :components]).any(-1).all()
    assert spread[0] < 1e-5 < spread[1] < spread[2]


def test_a_single_candidate_of_the_hybrid_is_the_mean_of_its_encoder():
    proposer = generator("hybrid", "stack")
    proposer.goal_mean += 0.2
    proposer.goal_std *= 0.1
    observation, goal = scene("stack", 4)
    candidates, log_prob = proposer.propose(observation, goal, 1)
    mean, scale = proposer.encode(observation, goal)
    torch.testing.assert_close(candidates[:, 0], mean * 0.1 + 0.2)
    torch.testing.assert_close(log_prob[:, 0], -(2 * scale).log().sum(-1))


def test_candidates_of_the_hybrid_are_draws_from_its_encoder():
    torch.manual_seed(0)
    proposer = generator("hybrid", "stack")
    observation, goal = scene("stack", 2)
    candidates, log_prob = proposer.propose(observation, goal, 20_000)
    mean, scale = proposer.encode(observation, goal)
    torch.testing.assert_close(candidates.mean(1), mean, atol=0.06, rtol=0)
    torch.testing.assert_close((candidates - mean[:, None]).abs().mean(1), scale, atol=0, rtol=0.05)
    expected = Laplace(mean[:, None], scale[:, None]).log_prob(candidates).sum(-1)
    torch.testing.assert_close(log_prob, expected, atol=1e-3, rtol=1e-4)


def test_goals_that_never_vary_do_not_trouble_the_hybrid():
    layout = LAYOUTS["stack"]
    observation, goal = scene("stack", 16)
    goal[:, 2] = 0.025
    moments = empty_moments(layout)
    moments["goal_mean"][2] = 0.025
    proposer = Hybrid(layout, moments, HybridConfig(layers=(16,)))
    loss, info = proposer.loss(observation, goal, goal)
    loss.backward()
    assert all(value.isfinite() for value in info.values())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in proposer.parameters())


def test_the_hybrid_weights_its_losses_as_eq_14_does():
    layout = LAYOUTS["stack"]
    observation, goal = scene("stack", 16)
    _, subgoal = scene("stack", 16, seed=1)
    found = []
    for beta in (0.0, 2.0):
        torch.manual_seed(0)
        proposer = Hybrid(layout, empty_moments(layout), HybridConfig(layers=(16,), beta=beta))
        loss, info = proposer.loss(observation, goal, subgoal)
        hybrid = info["reconstruction_error"] + info["divergence"]
        torch.testing.assert_close(loss.detach(), hybrid - beta * info["log_likelihood"])
        found.append(info["log_likelihood"])
    torch.testing.assert_close(*found)


def imagined(task: str, count: int):
    """Return the generator of an image task, and what it is asked about: latents are their row."""
    layout = LAYOUTS[task].seen(4)
    observation, goal = scene(task, count)
    latent = torch.randn(count, 4)
    seen = torch.cat([observation[:, : layout.observation_dim - 4], latent], 1)
    proposer = PicturedMovers(layout, empty_moments(layout), MoversConfig(width=16))
    return proposer, seen, torch.cat([goal, latent], 1)


def test_a_subgoal_seen_in_an_image_has_places_as_for_states_and_a_latent():
    torch.manual_seed(0)
    proposer, observation, goal = imagined("store", 5)
    drawn, log_prob = proposer.propose(observation, goal, 8)
    assert drawn.shape == (5, 8, 10) and log_prob.shape == (5, 8)
    plain = Movers(LAYOUTS["store"], MoversConfig(width=16))
    state = torch.cat([observation[:, :-4], torch.zeros(5, 2)], 1)
    shared = {k: v for k, v in proposer.state_dict().items() if k in plain.state_dict()}
    shared |= {k: v for k, v in plain.state_dict().items() if k.startswith("decoder")}
    plain.load_state_dict(shared)
    expected, weight = plain.propose(state, goal[:, :6], 8)
    torch.testing.assert_close(drawn[..., :6], expected)
    torch.testing.assert_close(log_prob, weight)
    assert drawn[..., 6:].std(1).min() > 0, "each candidate looks different"


def test_a_generator_learns_what_a_subgoal_looks_like():
    torch.manual_seed(0)
    proposer, observation, goal = imagined("open_drawer", 64)
    # It looks as it does now but where the block will be.
    subgoal = goal.clone()
    subgoal[:, 6:] = observation[:, -4:] + 3 * subgoal[:, :1]
    optimizer = torch.optim.Adam(proposer.parameters(), lr=5e-3)
    errors = []
    for _ in range(200):
        loss, info = proposer.loss(observation, goal, subgoal)
        errors.append(float(info["picture_error"]))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert errors[-1] < 0.02 * errors[0]
