"""The threshold between near and far, and latents scaled so that it is five centimetres."""

from __future__ import annotations

import numpy as np
import pytest

from eisp_data.storage.cache import load_arrays
from vqvae.calibrate import best_threshold, calibrate, check
from vqvae.latents import load_codes
from vqvae.saved import load


def test_the_threshold_parts_what_can_be_parted():
    values = np.array([0.1, 0.4, 0.2, 0.9, 0.7, 0.3])
    assert best_threshold(values, values < 0.5) == 0.4


def test_the_threshold_weighs_what_is_missed_against_what_is_mistaken():
    # Up to 2: three of four found, one of four mistaken; up to 4 all found, but three mistaken.
    values = np.array([1, 2, 2, 2, 3, 3, 4, 5])
    near = np.array([1, 1, 1, 0, 0, 0, 1, 0], bool)
    assert best_threshold(values, near) == 2


def test_equal_distances_are_on_one_side():
    values, near = np.array([1, 1, 1, 2]), np.array([1, 0, 0, 0], bool)
    assert best_threshold(values, near) == 1


def test_calibrated_latents_that_are_five_centimetres_apart_are_at_the_threshold(images, vqvae_run):
    model, vision = load(vqvae_run)
    arrays, codes = load_arrays(images), load_codes(images, model, vision.camera)
    before = float(model.unit)
    distance = calibrate(model, codes, arrays, np.arange(4))
    assert distance * float(model.unit) == pytest.approx(0.05)
    assert calibrate(model, codes, arrays, np.arange(4)) == pytest.approx(distance, rel=1e-4)
    found = check(model, codes, arrays, np.arange(4))
    assert found.distance == pytest.approx(distance, rel=1e-4)
    assert found.found + found.rejected > 1.2  # 1 is chance
    assert before != 1.0, "training calibrates, too"
