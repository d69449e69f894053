"""Perceptrons in an ensemble."""

import pytest
import torch
from torch import nn

from pretrain.networks import MLP, EnsembleMLP, hidden_dtype


@pytest.mark.parametrize("layer_norm", [False, True])
def test_an_ensemble_computes_what_its_members_would_alone(layer_norm):
    torch.manual_seed(0)
    ensemble = EnsembleMLP(3, 5, (7, 6), layer_norm=layer_norm)
    inputs = torch.randn(4, 5)
    values = ensemble(inputs)
    assert values.shape == (3, 4)
    for member in range(3):
        hidden = inputs
        for index, (weight, bias) in enumerate(zip(ensemble.weights, ensemble.biases, strict=True)):
            hidden = hidden @ weight[member] + bias[member]
            if index < 2:
                hidden = nn.functional.layer_norm(hidden, hidden.shape[-1:]) if layer_norm else (
                    hidden
                )  # fmt: skip
                hidden = hidden.relu()
        torch.testing.assert_close(values[member], hidden[:, 0])


def test_the_members_of_an_ensemble_learn_apart():
    torch.manual_seed(0)
    ensemble = EnsembleMLP(2, 3, (4,), layer_norm=True)
    ensemble(torch.randn(8, 3))[0].sum().backward()
    for parameter in (*ensemble.weights, *ensemble.biases):
        assert parameter.grad is not None
        assert (parameter.grad[0] != 0).any() and (parameter.grad[1] == 0).all()


def test_the_gradients_of_an_ensemble_are_those_of_small_differences():
    torch.manual_seed(0)
    ensemble = EnsembleMLP(2, 3, (4,), layer_norm=False).double()
    inputs = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)

    def value(inputs: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        return ensemble(inputs).sin()

    assert torch.autograd.gradcheck(value, (inputs, *ensemble.parameters()))


def test_a_perceptron_without_hidden_layers_is_linear():
    assert [type(module) for module in MLP(3, (), 2)] == [nn.Linear]
    kinds = [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert [type(module) for module in MLP(3, (5, 4), 2)] == kinds


@pytest.fixture
def bf16_allowed():
    torch.backends.mkldnn.matmul.fp32_precision = "bf16"
    if hidden_dtype(torch.zeros(1)) != torch.bfloat16:
        pytest.skip("this processor has no bf16 products")


@pytest.mark.parametrize(
    "network", [MLP(40, (64, 64), 3), EnsembleMLP(2, 40, (64, 64), layer_norm=True)]
)
@pytest.mark.usefixtures("bf16_allowed")
def test_bf16_hidden_layers_give_nearly_what_fp32_gives_and_fp32_gradients(network):
    torch.manual_seed(0)
    inputs = torch.randn(500, 40)
    found = []
    for precision in ("bf16", "ieee"):
        torch.backends.mkldnn.matmul.fp32_precision = precision
        network.zero_grad()
        output = network(inputs)
        output.square().mean().backward()
        assert output.dtype == torch.float32
        found.append((output.detach(), next(network.parameters()).grad))
    for rough, exact in zip(*found, strict=True):
        assert rough.dtype == torch.float32
        assert 0 < (rough - exact).norm() < 0.06 * exact.norm()
