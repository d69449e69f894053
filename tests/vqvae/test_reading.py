"""Places are read off latents, in metres; what is not in the picture is not counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from image_samples import TINY

from eisp_data.storage.cache import load_arrays
from vqvae.latents import load_codes, see
from vqvae.losses import loss
from vqvae.model import VqVae
from vqvae.reading import Reader, check, learn, on_table
from vqvae.saved import load

RNG = np.random.default_rng(0)


def test_a_place_that_bends_with_the_latent_is_read_to_the_millimetre():
    torch.manual_seed(0)
    latents = RNG.uniform(-1, 1, (4000, 4)).astype(np.float32)
    places = 0.3 + 0.2 * np.stack([latents[:, 0] * latents[:, 1], latents[:, 2] ** 2], 1)
    places = np.hstack([places, np.full((4000, 1), 0.1)]).astype(np.float32)
    reader = Reader(4, 3)
    reader.set_moments(places)
    learn(reader, latents[:3000], places[:3000], 1500, np.random.default_rng(0))
    with torch.no_grad():
        apart = reader(torch.from_numpy(latents[3000:])).numpy() - places[3000:]
    assert np.linalg.norm(apart, axis=1).mean() < 0.005 < places[:, 0].std()


def test_the_loss_is_the_distance_of_both_from_the_truth():
    reader = Reader(2, 6)
    for part in reader.parameters():
        part.data.zero_()
    places = torch.tensor([[0.3, 0.4, 0.0, 0.0, 0.0, 0.1]])
    assert reader.loss(torch.zeros(1, 2), places).item() == pytest.approx(2 * (5.0 + 1.0) / 2)


def test_what_fell_off_the_table_or_lies_far_away_is_not_in_the_picture():
    here, fallen, far = (0.3, 0.1, 0.02), (0.3, 0.1, -0.2), (0.9, 0.1, 0.02)
    rows = np.array([[*here, *here], [*here, *fallen], [*far, *here]])
    assert on_table(rows).tolist() == [True, False, False]


def test_places_that_are_read_exactly_leave_no_doubt(images):
    arrays = load_arrays(images)
    found = check(arrays.achieved_goal, arrays, np.arange(4), ["block", "handle"])
    assert found.mean_mm == found.percentile_95_mm == {"handle": 0.0, "block": 0.0}
    assert (found.found, found.rejected, found.right) == (1.0, 1.0, 1.0)


def test_places_that_are_never_told_apart_all_seem_near(images):
    arrays = load_arrays(images)
    constant = np.broadcast_to(arrays.achieved_goal.mean(0), arrays.achieved_goal.shape)
    found = check(constant, arrays, np.arange(4), ["block", "handle"])
    assert (found.found, found.rejected) == (1.0, 0.0) and 0 < found.right < 1


def test_training_teaches_the_reader(images, vqvae_run):
    model, vision = load(vqvae_run)
    arrays, codes = load_arrays(images), load_codes(images, model, vision.camera)
    names = ["block", "handle"]
    seen = see(model, codes)
    assert seen.shape == (len(codes), 108 + 6)
    learned = check(seen[:, :6], arrays, np.arange(4), names)
    constant = np.broadcast_to(arrays.achieved_goal.mean(0), (len(codes), 6))
    unknown = check(constant, arrays, np.arange(4), names)
    for name in names:
        assert learned.mean_mm[name] < 0.5 * unknown.mean_mm[name]


def test_the_reader_leaves_the_codes_as_they_are(vqvae_run):
    model, _ = load(vqvae_run)
    before = model.fingerprint()
    with torch.no_grad():
        model.reader.centre += 1.0
    assert model.fingerprint() == before


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_places_shape_the_codes_only_if_they_have_a_weight(weight):
    torch.manual_seed(0)
    model = VqVae(replace(TINY, reading=weight), 6)
    images = torch.randint(0, 256, (4, 48, 48, 3), dtype=torch.uint8)
    gradients = []
    for places in (torch.zeros(4, 6), torch.full((4, 6), 5.0)):
        model.zero_grad()
        loss(model, images, places, fast=False)[0].backward()
        gradients.append([model.encoder[0].weight.grad.clone(), model.reader.plain.bias.grad])
    of_encoder, of_reader = zip(*gradients, strict=True)
    assert torch.equal(*of_encoder) == (weight == 0.0)
    assert not torch.equal(*of_reader)
