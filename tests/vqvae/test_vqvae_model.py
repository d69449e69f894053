"""The VQ-VAE's sizes are the paper's; latents and images are two views of the same codes."""

from __future__ import annotations

import pytest
import torch

from vqvae.config import VqVaeConfig
from vqvae.model import VqVae


@pytest.fixture
def model() -> VqVae:
    torch.manual_seed(0)
    made = VqVae(VqVaeConfig(channels=(4, 8), codes=40), 6)
    made.codebook.code.normal_()
    return made


@pytest.fixture
def images() -> torch.Tensor:
    return torch.randint(0, 256, (5, 48, 48, 3), dtype=torch.uint8)


def test_three_halvings_make_the_papers_latent_of_3_by_6_by_6(model, images):
    assert model.encoder(model.standardise(images)).shape == (5, 3, 6, 6)
    assert model.latent_dim == 108
    halvings = [layer for layer in model.encoder if isinstance(layer, torch.nn.Conv2d)]
    doublings = [x for x in model.decoder if isinstance(x, torch.nn.ConvTranspose2d)]
    assert len(halvings) == len(doublings) == 3
    assert {(x.kernel_size, x.stride) for x in (*halvings, *doublings)} == {((4, 4), (2, 2))}
    assert [x.in_channels for x in halvings] == [x.out_channels for x in doublings[::-1]]


def test_codes_latents_and_images_go_together(model, images):
    index = model.encode(images)
    assert index.shape == (5, 36) and int(index.min()) >= 0 and int(index.max()) < 40
    latent = model.embed(index)
    assert latent.shape == (5, 108)
    expected = model.picture(model.decode_cells(model.codebook.code[index.flatten()]))
    assert torch.equal(model.decode(latent), expected)


def test_a_latent_beside_a_code_is_decoded_as_that_code(model, images):
    latent = model.embed(model.encode(images))
    assert torch.equal(model.decode(latent + 1e-4 * torch.randn_like(latent)), model.decode(latent))


def test_what_is_seen_is_the_latent_and_the_places_that_are_read_off_it(model, images):
    index = model.encode(images)
    seen, latent = model.see(index), model.embed(index)
    assert seen.shape == (5, model.seen_dim) and model.seen_dim == 108 + 6
    assert torch.equal(seen[:, 6:], latent)
    assert torch.equal(seen[:, :6], model.reader(latent))


def test_standardising_and_picturing_are_inverse(model, images):
    model.set_moments(torch.rand(48, 48, 3), torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(model.picture(model.standardise(images)), images)


def test_the_fingerprint_is_that_of_the_weights(model):
    first = model.fingerprint()
    assert model.fingerprint() == first
    model.decoder[0].bias.data[0] += 1e-3
    assert model.fingerprint() != first


def test_larger_images_have_more_cells():
    assert VqVae(VqVaeConfig(image_size=(64, 48), channels=(4, 4)), 6).grid == (8, 6)
