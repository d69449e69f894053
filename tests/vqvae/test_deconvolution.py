"""The faster transposed convolution is the same function with the same gradients."""

from __future__ import annotations

import pytest
import torch

from vqvae.deconvolution import Double


@pytest.mark.parametrize(("inputs", "outputs"), [(3, 8), (8, 5), (5, 3)])
def test_values_and_gradients_are_those_of_the_transposed_convolution(inputs, outputs):
    torch.manual_seed(0)
    plain, own = torch.nn.ConvTranspose2d(inputs, outputs, 4, 2, 1), Double(inputs, outputs)
    own.load_state_dict(plain.state_dict())
    seen = [torch.randn(3, inputs, 6, 4, requires_grad=True)]
    seen.append(seen[0].detach().clone().requires_grad_())
    slope = torch.randn(3, outputs, 12, 8)
    for layer, images in zip((plain, own), seen, strict=True):
        layer(images).backward(slope)
    assert torch.equal(plain(seen[0]), own(seen[0]))
    for theirs, ours in zip(
        (*plain.parameters(), seen[0]), (*own.parameters(), seen[1]), strict=True
    ):
        assert torch.allclose(theirs.grad, ours.grad, atol=1e-4)


def test_in_bfloat16_the_gradients_are_near_and_of_the_parameters_type():
    torch.manual_seed(0)
    layer, images = Double(4, 6), torch.randn(2, 4, 6, 6, requires_grad=True)
    slope = torch.randn(2, 6, 12, 12)
    layer(images).backward(slope)
    exact = [p.grad.clone() for p in (*layer.parameters(), images)]
    layer.zero_grad()
    images.grad = None
    with torch.autocast("cpu", torch.bfloat16):
        output = layer(images)
    output.backward(slope.to(output.dtype))
    for before, parameter in zip(exact, (*layer.parameters(), images), strict=True):
        assert parameter.grad.dtype == torch.float32
        assert (parameter.grad - before).norm() < 0.02 * before.norm()
