"""Codes are computed once for a dataset and a VQ-VAE, and never served for another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from eisp_data.errors import DataError
from eisp_data.storage.cache import load_arrays, load_images
from eisp_data.tasks.registry import get_task
from pretrain.layout import Layout
from vqvae import latents
from vqvae.saved import load


def test_codes_are_computed_once_and_mapped(images, vqvae_run, monkeypatch):
    model, vision = load(vqvae_run)
    first = latents.load_codes(images, model, vision.camera)
    monkeypatch.setattr(latents, "encode", lambda *_: pytest.fail("computed again"))
    again = latents.load_codes(images, model, vision.camera)
    assert isinstance(again, np.memmap) and np.array_equal(first, again)


def test_other_weights_are_other_codes(images, vqvae_run):
    model, vision = load(vqvae_run)
    first = np.array(latents.load_codes(images, model, vision.camera))
    model.encoder[0].weight.data *= -1.0
    other = latents.load_codes(images, model, vision.camera)
    assert np.array_equal(other, latents.encode(model, load_images(images, vision.camera)))
    assert not np.array_equal(first, other)


def test_an_image_task_sees_the_robot_and_latents_and_no_object(images, vqvae_run):
    model, vision = load(vqvae_run)
    seen, states = latents.load_latent_arrays(images, model, vision), load_arrays(images)
    codes = latents.load_codes(images, model, vision.camera)
    assert seen.spec.task == "open_drawer_image"
    assert (seen.spec.observation_dim, seen.spec.goal_dim) == (10 + 2 * 15 + 108, 6 + 108)
    assert np.array_equal(seen.observation[:, :10], states.observation[:, :10])
    assert np.array_equal(seen.observation[:, 40:], latents.see(model, codes)[:, 6:])
    assert np.array_equal(seen.achieved_goal, latents.see(model, codes))
    assert seen.desired_goal.shape == (4, 114)
    for name in ("action", "reward", "success", "episode_start"):
        assert np.array_equal(getattr(seen, name), getattr(states, name))


def test_what_is_seen_is_laid_out_as_the_states_are():
    task = get_task("store")
    state = np.stack([task.reset(np.random.default_rng(seed))[0] for seed in (0, 1)])
    truth = task.observe(state)
    seen = np.hstack([task.achieved_goal(state), np.full((2, 108), 7.0)])
    observation = latents.observe(truth[:, :10], seen, 6)
    layout = Layout.of(task)
    assert observation.shape[1] == layout.seen(108).observation_dim
    assert (observation[:, -108:] == 7.0).all()
    for item in layout.objects:
        shown = slice(item.observation, item.observation + 6)
        np.testing.assert_allclose(observation[:, shown], truth[:, shown], atol=1e-6)
        assert not observation[:, item.observation + 6 : item.observation + 15].any()


def test_a_dataset_of_another_task_is_refused(images, vqvae_run):
    model, vision = load(vqvae_run)
    with pytest.raises(DataError, match="of 'open_drawer', the VQ-VAE was trained on 'store'"):
        latents.load_latent_arrays(images, model, replace(vision, task="store"))


def test_an_image_task_is_collected_with_its_images(images, tmp_path):
    from eisp_data.cli.collect import CollectConfig, collect
    from eisp_data.storage.reader import read_spec

    collect(CollectConfig(tmp_path / "seen", task="open_drawer_image", episodes=1, workers=1))
    spec = read_spec(tmp_path / "seen")
    assert (spec.task, dict(spec.cameras)) == ("open_drawer", {"shoulder": (48, 48)})
    ours, theirs = load_images(tmp_path / "seen", "shoulder"), load_images(images, "shoulder")
    # The same seed: drawn while it is collected, or afterwards.
    assert np.abs(ours.astype(int) - theirs[: len(ours)]).mean() < 1.0
