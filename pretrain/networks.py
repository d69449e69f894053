"""Multilayer perceptrons, single and in ensembles."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


def mlp(inputs: int, layers: Sequence[int], outputs: int) -> nn.Sequential:
    """Return a ReLU perceptron with the given hidden layers and a linear output."""
    sizes = [inputs, *layers]
    modules: list[nn.Module] = []
    for size_in, size_out in zip(sizes, sizes[1:], strict=False):
        modules += [nn.Linear(size_in, size_out), nn.ReLU()]
    return nn.Sequential(*modules, nn.Linear(sizes[-1], outputs))


class EnsembleMLP(nn.Module):
    """Independent perceptrons of one shape, evaluated in one batched product a layer.

    Args:
        members: how many perceptrons.
        inputs: features of an input.
        layers: hidden sizes.
        layer_norm: whether every hidden layer is normalised before its ReLU, which keeps the
            values of unseen actions from running away (Ball et al. 2023, RLPD).
    """

    def __init__(
        self, members: int, inputs: int, layers: Sequence[int], *, layer_norm: bool
    ) -> None:
        super().__init__()
        sizes = [inputs, *layers, 1]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        self.scales, self.shifts = nn.ParameterList(), nn.ParameterList()
        self.layer_norm = layer_norm
        for size_in, size_out in zip(sizes, sizes[1:], strict=False):
            bound = size_in**-0.5
            self.weights.append(torch.empty(members, size_in, size_out).uniform_(-bound, bound))
            self.biases.append(torch.empty(members, 1, size_out).uniform_(-bound, bound))
        for size in layers if layer_norm else ():
            self.scales.append(torch.ones(members, 1, size))
            self.shifts.append(torch.zeros(members, 1, size))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (members, B) values of (B, inputs) features."""
        members = len(self.weights[0])
        hidden = inputs.expand(members, *inputs.shape)
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if index < last:
                if self.layer_norm:
                    hidden = nn.functional.layer_norm(hidden, hidden.shape[-1:])
                    hidden = hidden * self.scales[index] + self.shifts[index]
                hidden = torch.relu(hidden)
        return hidden.squeeze(-1)
