"""PSNR, SSIM and perplexity are what their definitions say."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vqvae.quality import perplexity, psnr, ssim

GREY = torch.full((2, 48, 48, 3), 100, dtype=torch.uint8)


def test_psnr_of_a_known_error():
    assert psnr(GREY, GREY + 10).numpy() == pytest.approx(20 * np.log10(255 / 10), abs=1e-4)


def test_ssim_is_one_for_the_same_image_and_falls_with_noise():
    torch.manual_seed(0)
    image = torch.randint(0, 256, (3, 48, 48, 3), dtype=torch.uint8)
    assert torch.allclose(ssim(image, image), torch.ones(3), atol=1e-5)
    noisy = [(image + s * torch.randn(image.shape)).clamp(0, 255).byte() for s in (5, 40)]
    little, much = (ssim(image, other).mean() for other in noisy)
    assert 1 > little > much > 0


def test_ssim_of_two_flat_images_is_their_luminance_term():
    c1, x, y = 0.01**2, 100 / 255, 150 / 255
    expected = (2 * x * y + c1) / (x * x + y * y + c1)
    assert ssim(GREY, GREY + 50).numpy() == pytest.approx(expected, abs=1e-3)


def test_perplexity_counts_the_codes_that_are_used_alike():
    assert perplexity(torch.tensor([7, 7, 7, 7, 0])) == pytest.approx(4)
    assert perplexity(torch.tensor([0, 9, 0])) == pytest.approx(1)
