"""Soft Actor-Critic against what can be worked out by hand."""

from dataclasses import replace

import pytest
import torch
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from pretrain.agent import empty_moments
from pretrain.config import SacConfig
from pretrain.features import PlainFeatures
from pretrain.layout import Layout
from pretrain.sac import Batch, Sac

LINEAR = SacConfig(layers=(), layer_norm=False, alpha=0.0, gamma=0.9)


def make_sac(config: SacConfig = LINEAR, state: int = 1, goal: int = 1, action: int = 1) -> Sac:
    """Return a Sac of a plain world; with linear networks all its weights are zero."""
    torch.manual_seed(0)
    layout = Layout(state, goal, action)
    features = PlainFeatures(layout, empty_moments(layout))
    sac = Sac(features, action, config)
    if not config.layers:
        for parameter in sac.parameters():
            parameter.data.zero_()
    return sac


def make_batch(
    count: int = 8, action: float | torch.Tensor = 0.0, **changes: torch.Tensor
) -> Batch:
    values = {
        "observation": torch.zeros(count, 1),
        "action": torch.ones(count, 1) * action,
        "next_observation": torch.zeros(count, 1),
        "goal": torch.zeros(count, 1),
        "reward": -torch.ones(count),
        "clone": torch.zeros(count),
        "demonstrated": torch.zeros(count),
    }
    return Batch(**{**values, **changes})


def critic_loss(sac: Sac, batch: Batch, noise: torch.Tensor):
    return sac.critic_loss(batch, *sac.see(batch), noise)


def actor_loss(sac: Sac, batch: Batch, noise: torch.Tensor, cloning: float):
    return sac.actor_loss(batch, sac.see(batch)[0], noise, cloning)


def test_the_log_probability_is_that_of_a_squashed_gaussian():
    sac = make_sac(replace(LINEAR, layers=(16,)), action=3).double()
    observation, goal = torch.randn(2, 500, 1, dtype=torch.float64).unbind(0)
    seen = sac.features(observation, goal)
    action, log_prob, mode = sac.actor.sample(seen)
    mean, log_std = sac.actor(seen)
    squashed = TransformedDistribution(
        Independent(Normal(mean, log_std.exp()), 1), TanhTransform(cache_size=1)
    )
    torch.testing.assert_close(log_prob, squashed.log_prob(action), atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(mode, mean.tanh())


def test_actions_far_out_have_finite_log_probabilities():
    sac = make_sac()
    sac.actor.body[-1].bias.data[:] = torch.tensor([30.0, 5.0])
    action, log_prob, _ = sac.actor.sample(torch.zeros(100, 2))
    assert log_prob.isfinite().all() and (action.abs() <= 1).all()


def test_an_action_is_the_mean_and_as_much_noise_as_is_asked_for():
    sac = make_sac()
    sac.actor.body[-1].bias.data[:] = torch.tensor([0.5, -1.0])
    many = torch.zeros(20_000, 1)
    still, half, whole = (sac.act(many, many, noise) for noise in (0.0, 0.5, 1.0))
    torch.testing.assert_close(still, torch.full((20_000, 1), 0.5).tanh())
    for moving, noise in ((half, 0.5), (whole, 1.0)):
        assert moving.atanh().std().item() == pytest.approx(noise * torch.e**-1, rel=0.05)
        assert (moving.abs() <= 1).all()


def test_the_value_is_the_lesser_twin_less_the_price_of_certainty():
    sac = make_sac(replace(LINEAR, alpha=0.1))
    sac.critic.body.biases[-1].data[:, 0, 0] = torch.tensor([-3.0, -5.0])
    observation, goal = torch.zeros(40_000, 1), torch.zeros(40_000, 1)
    value = sac.value(observation, goal)
    _, log_prob, _ = sac.actor.sample(sac.features(observation, goal))
    assert value.mean().item() == pytest.approx(-5.0 - 0.1 * log_prob.mean().item(), abs=0.01)


@pytest.mark.parametrize(
    ("future", "clip", "target"),
    [(100.0, True, 0.0), (-100.0, True, -10.0), (-4.0, True, -4.6), (-100.0, False, -91.0)],
)
def test_targets_are_clipped_to_what_the_reward_allows(future, clip, target):
    sac = make_sac(replace(LINEAR, clip_targets=clip))
    sac.target.body.biases[-1].data[:] = future
    loss, info = critic_loss(sac, make_batch(), torch.randn(8, 1))
    assert sac.lowest_value == pytest.approx(-10.0)
    assert loss.item() == pytest.approx(target**2, abs=1e-4)
    assert info["value"].item() == 0.0


def test_the_target_takes_the_lesser_of_its_twins():
    sac = make_sac()
    sac.target.body.biases[-1].data[:, 0, 0] = torch.tensor([-2.0, -6.0])
    loss, _ = critic_loss(sac, make_batch(), torch.randn(8, 1))
    assert loss.item() == pytest.approx((-1 + 0.9 * -6) ** 2, rel=1e-5)


def test_values_of_a_chain_are_found():
    """Cell i leads to i + 1, the last stays: -(1 - gamma^k) / (1 - gamma), k steps from it."""
    cells, gamma = 5, 0.8
    sac = make_sac(SacConfig(layers=(32,), alpha=0.0, gamma=gamma, tau=0.3, cloning=0.0))
    critic, actor = (torch.optim.Adam(part.parameters(), 3e-3) for part in (sac.critic, sac.actor))
    cell = torch.arange(cells).repeat(4)
    following = (cell + 1).clamp(max=cells - 1)
    for _ in range(900):
        batch = make_batch(
            len(cell),
            observation=cell[:, None] / 2.0,
            next_observation=following[:, None] / 2.0,
            action=torch.rand(len(cell), 1) * 2 - 1,
            reward=torch.where(following == cells - 1, 0.0, -1.0),
        )
        noise = torch.randn(len(cell), 1)
        critic.zero_grad()
        critic_loss(sac, batch, noise)[0].backward()
        critic.step()
        actor.zero_grad()
        actor_loss(sac, batch, noise, 0.0)[0].backward()
        actor.step()
        sac.follow()
    steps = (cells - 2 - torch.arange(cells)).clamp(min=0)
    exact = -(1 - gamma**steps) / (1 - gamma)
    value = sac.value(torch.arange(cells)[:, None] / 2.0, torch.zeros(cells, 1))
    torch.testing.assert_close(value, exact, atol=0.15, rtol=0)


def test_the_actor_climbs_the_critic():
    sac = make_sac()
    sac.critic.body.weights[-1].data[:, -1] = 1.0
    optimizer = torch.optim.Adam(sac.actor.parameters(), lr=0.05)
    for _ in range(40):
        loss, _ = actor_loss(sac, make_batch(), torch.randn(8, 1), 0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert sac.act(torch.zeros(1, 1), torch.zeros(1, 1)).item() > 0.7


@pytest.mark.parametrize(
    ("clone", "demonstrated", "action", "cloned"),
    [
        (1.0, 1.0, 0.9, True),
        (1.0, 1.0, -0.9, True),
        (0.0, 1.0, 0.9, False),
        (1.0, 0.0, 0.9, True),
        (1.0, 0.0, -0.9, False),
        (0.0, 0.0, 0.9, False),
    ],
)
def test_of_its_own_actions_only_better_ones_are_cloned(clone, demonstrated, action, cloned):
    sac = make_sac()
    # The value of an action is the action; the policy's own are near zero.
    sac.critic.body.weights[-1].data[:, -1] = 1.0
    sac.actor.body[-1].bias.data[1] = -5.0
    batch = make_batch(
        action=action, clone=torch.full((8,), clone), demonstrated=torch.full((8,), demonstrated)
    )
    _, info = actor_loss(sac, batch, torch.randn(8, 1), 1.0)
    assert info["cloning_error"].item() == pytest.approx(action**2 if cloned else 0.0, abs=1e-5)


def test_cloning_weighs_the_mean_error_of_what_is_cloned():
    sac = make_sac()
    batch = make_batch(
        4,
        action=torch.tensor([[0.5], [1.0], [1.0], [1.0]]),
        clone=torch.tensor([1.0, 1.0, 0.0, 0.0]),
        demonstrated=torch.ones(4),
    )
    noise = torch.randn(4, 1)
    plain, _ = actor_loss(sac, batch, noise, 0.0)
    loss, info = actor_loss(sac, batch, noise, 3.0)
    assert info["cloning_error"].item() == pytest.approx((0.25 + 1.0) / 2)
    assert (loss - plain).item() == pytest.approx(3.0 * 0.625)


def test_the_target_follows_by_tau_exactly():
    sac = make_sac(replace(LINEAR, layers=(8,), layer_norm=True, tau=0.03))
    with torch.no_grad():
        for parameter in sac.critic.parameters():
            parameter += torch.randn_like(parameter)
    old = [parameter.clone() for parameter in sac.target.parameters()]
    sac.follow()
    triples = zip(old, sac.critic.parameters(), sac.target.parameters(), strict=True)
    for before, source, after in triples:
        torch.testing.assert_close(after, 0.97 * before + 0.03 * source)


def test_batches_join_part_after_part():
    joined = Batch.joined([make_batch(2, action=0.1), make_batch(3, action=0.2)])
    assert joined.action[:, 0].tolist() == pytest.approx([0.1, 0.1, 0.2, 0.2, 0.2])
    assert len(joined.reward) == len(joined.clone) == len(joined.demonstrated) == 5
