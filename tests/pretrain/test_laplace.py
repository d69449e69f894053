"""The Laplace distribution: density, divergence, samples and their gradients."""

import pytest
import torch
from torch.distributions import Laplace, Normal

from pretrain.proposers import laplace

CASES = [(0.0, 1.0), (-1.3, 0.2), (0.7, 2.5)]


@pytest.mark.parametrize(("mean", "scale"), CASES)
def test_the_density_integrates_to_one(mean, scale):
    value = torch.linspace(mean - 40 * scale, mean + 40 * scale, 100_001, dtype=torch.float64)
    density = laplace.log_prob(
        value[:, None], torch.full((1, 1), mean), torch.full((1, 1), scale)
    ).exp()
    assert torch.trapezoid(density, value).item() == pytest.approx(1.0, abs=1e-5)


def test_the_density_of_several_dimensions_is_the_product_of_theirs():
    generator = torch.Generator().manual_seed(0)
    value, mean, scale = torch.rand(3, 5, 4, generator=generator).unbind(0)
    expected = Laplace(mean, scale + 0.1).log_prob(value).sum(-1)
    torch.testing.assert_close(laplace.log_prob(value, mean, scale + 0.1), expected)


@pytest.mark.parametrize(("mean", "scale"), CASES)
def test_the_divergence_from_the_prior_is_what_samples_say(mean, scale):
    torch.manual_seed(0)
    ours, prior = Laplace(mean, scale), Normal(0.0, 1.0)
    value = ours.sample((200_000,))
    ratio = ours.log_prob(value) - prior.log_prob(value)
    error = ratio.std().item() / len(ratio) ** 0.5
    found = laplace.kl_to_standard_normal(torch.tensor([mean]), torch.tensor([scale]))
    assert found.item() == pytest.approx(ratio.mean().item(), abs=4 * error)
    assert found.item() > 0


def test_the_divergence_adds_up_over_dimensions():
    mean, scale = torch.tensor([[0.3, -2.0]]), torch.tensor([[0.5, 1.5]])
    each = [laplace.kl_to_standard_normal(mean[:, i : i + 1], scale[:, i : i + 1]) for i in (0, 1)]
    torch.testing.assert_close(laplace.kl_to_standard_normal(mean, scale), each[0] + each[1])


@pytest.mark.parametrize(("mean", "scale"), CASES)
def test_samples_have_the_moments_of_the_distribution(mean, scale):
    torch.manual_seed(0)
    drawn = laplace.sample(torch.full((400_000,), mean), torch.full((400_000,), scale))
    assert drawn.isfinite().all()
    assert drawn.mean().item() == pytest.approx(mean, abs=0.01 * scale)
    assert drawn.var().item() == pytest.approx(2 * scale**2, rel=0.03)
    assert (drawn - mean).abs().mean().item() == pytest.approx(scale, rel=0.01)
    below = [(drawn < quantile).float().mean() for quantile in Laplace(mean, scale).icdf(
        torch.tensor([0.05, 0.25, 0.75, 0.95]))]  # fmt: skip
    torch.testing.assert_close(
        torch.stack(below), torch.tensor([0.05, 0.25, 0.75, 0.95]), atol=3e-3, rtol=0
    )


def test_gradients_flow_through_samples_to_mean_and_scale():
    torch.manual_seed(0)
    mean = torch.zeros(1000, requires_grad=True)
    scale = torch.full((1000,), 2.0, requires_grad=True)
    drawn = laplace.sample(mean, scale)
    drawn.sum().backward()
    torch.testing.assert_close(mean.grad, torch.ones(1000))
    torch.testing.assert_close(scale.grad, (drawn / 2.0).detach())
