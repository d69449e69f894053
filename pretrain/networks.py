"""Multilayer perceptrons, single and in ensembles.

Their hidden layers are bf16 where ``pretrain.device`` allows it and the processor multiplies it
natively: twice as fast. Parameters, sums, losses and what the last layer gives stay fp32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn


def hidden_dtype(inputs: Tensor) -> torch.dtype:
    """Return the type of the hidden layers behind these inputs."""
    allowed = torch.backends.mkldnn.matmul.fp32_precision  # type: ignore[attr-defined]
    fast = inputs.device.type == "cpu" and allowed == "bf16"
    return torch.bfloat16 if fast and torch.cpu._is_avx512_bf16_supported() else inputs.dtype


class MLP(nn.Sequential):
    """A ReLU perceptron with the given hidden layers and a linear output."""

    def __init__(self, inputs: int, layers: Sequence[int], outputs: int) -> None:
        sizes = [inputs, *layers]
        modules: list[nn.Module] = []
        for size_in, size_out in zip(sizes, sizes[1:], strict=False):
            modules += [nn.Linear(size_in, size_out), nn.ReLU()]
        super().__init__(*modules, nn.Linear(sizes[-1], outputs))

    def forward(self, inputs: Tensor) -> Tensor:
        """Return (..., outputs) of (..., inputs)."""
        dtype = hidden_dtype(inputs)
        *layers, last = (module for module in self if isinstance(module, nn.Linear))
        hidden = inputs.to(dtype)
        for layer in layers:
            weight, bias = layer.weight.to(dtype), layer.bias.to(dtype)
            hidden = nn.functional.linear(hidden, weight, bias).relu()
        output: Tensor = last(hidden.to(inputs.dtype))
        return output


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
        dtype = hidden_dtype(inputs)
        *weights, last_weight = self.weights
        *biases, last_bias = self.biases
        hidden = inputs.to(dtype).expand(len(last_weight), *inputs.shape)
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            hidden = torch.baddbmm(bias.to(dtype), hidden, weight.to(dtype))
            if self.layer_norm:
                scale, shift = self.scales[index].to(dtype), self.shifts[index].to(dtype)
                hidden = nn.functional.layer_norm(hidden, hidden.shape[-1:])
                hidden = torch.addcmul(shift, hidden, scale)
            hidden = torch.relu(hidden)
        single: Tensor = _SingleOutput.apply(hidden, last_weight)
        return single + last_bias[:, 0]


class _SingleOutput(torch.autograd.Function):
    """The product with a single column, (M, B, K) by (M, K, 1), as the sum (M, B) that it is.

    Summed and returned in the weights' type; gradients are worked out in that of the layers before.
    That takes a third of the time.
    """

    @staticmethod
    def forward(ctx: Any, hidden: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(hidden, weight)
        return (hidden * weight.mT).sum(-1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        hidden, weight = ctx.saved_tensors
        gradient = gradients[0].to(hidden.dtype)
        of_hidden = of_weight = None
        if ctx.needs_input_grad[0]:
            of_hidden = torch.bmm(gradient[..., None], weight.mT.to(hidden.dtype))
        if ctx.needs_input_grad[1]:
            of_weight = torch.bmm(gradient[:, None], hidden).mT.to(weight.dtype)
        return of_hidden, of_weight
