"""A probe finds what is linear in latents or codes, and says what it would be without them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from vqvae.probe import probe

RNG = np.random.default_rng(0)
CODES = RNG.integers(0, 7, (3000, 4))
LATENTS = RNG.normal(size=(3000, 5))
ROWS, HELD = np.arange(2000), np.arange(2000, 3000)


def errors(place: np.ndarray):
    arrays = SimpleNamespace(achieved_goal=place.astype(np.float32))
    return probe(LATENTS, CODES, 7, arrays, ["block"], ROWS, HELD)["block"]  # type: ignore[arg-type]


def test_a_place_that_is_linear_in_the_latent_is_found():
    found = errors(0.2 + 0.03 * np.tanh(LATENTS @ RNG.normal(size=(5, 3)) / 50))
    assert found.latent_mm < 0.2 * found.unknown_mm and found.codes_mm > 0.9 * found.unknown_mm


def test_a_place_that_is_a_sum_over_cells_is_found_in_the_codes():
    table = RNG.uniform(0.0, 0.05, (4, 7, 3))
    found = errors(0.1 + sum(table[cell, CODES[:, cell]] for cell in range(4)))
    assert found.codes_mm < 0.5 < 10 < found.unknown_mm and found.latent_mm > 10


def test_what_fell_off_the_table_does_not_count():
    place = np.full((3000, 3), 0.2)
    place[::3] = (-9.0, 3.0, -50.0)
    assert errors(place).unknown_mm < 1e-3
