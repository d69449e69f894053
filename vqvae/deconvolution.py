"""A transposed convolution whose gradients are computed by ordinary convolutions.

The gradient of a transposed convolution with respect to its input is a convolution, and that with
respect to its weight the weight gradient of that convolution with the two roles exchanged. Asked
directly, PyTorch 2.11 takes 2.4 times as long for both on processors.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

_STRIDE, _PADDING = (2, 2), (1, 1)


class _Double(torch.autograd.Function):
    """Transposed convolution of 4 x 4 with stride 2 and padding 1."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        output = nn.functional.conv_transpose2d(inputs, weight, bias, _STRIDE, _PADDING)
        ctx.save_for_backward(inputs, weight)
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # The loss gives it in another order; it is small, and all that follows is in this one.
        gradient = gradients[0].contiguous(memory_format=torch.channels_last)
        inputs, weight = (saved.to(gradient.dtype) for saved in ctx.saved_tensors)
        _, by_weight, _ = torch.ops.aten.convolution_backward(
            inputs, gradient, weight, None, _STRIDE, _PADDING, (1, 1), False, (0, 0), 1,
            (False, True, False),
        )  # fmt: skip
        by_input = nn.functional.conv2d(gradient, weight, None, _STRIDE, _PADDING)
        first, second = ctx.saved_tensors
        return by_input.to(first.dtype), by_weight.to(second.dtype), gradient.sum((0, 2, 3)).float()


class Double(nn.ConvTranspose2d):
    """A transposed convolution of 4 x 4 that doubles height and width."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, kernel_size=4, stride=_STRIDE, padding=_PADDING)

    def forward(self, inputs: Tensor, output_size: list[int] | None = None) -> Tensor:
        """Return (B, outputs, 2 H, 2 W) of (B, inputs, H, W)."""
        assert self.bias is not None
        return _Double.apply(inputs, self.weight, self.bias)
