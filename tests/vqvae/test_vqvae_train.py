"""A tiny VQ-VAE learns, survives interruption bit for bit, and says what it cannot use."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from image_samples import TINY, drawn_dataset, tiny_training

from eisp_data.cli.collect import CollectConfig, collect
from eisp_data.errors import ConfigError, DataError
from eisp_data.runs.episodes import rows_of, split
from eisp_data.storage.cache import load_arrays, load_images
from vqvae import cli, reading, saved
from vqvae import evaluate as evaluate_module
from vqvae import train as training
from vqvae.config import VqVaeTrainConfig
from vqvae.presets import preset
from vqvae.quality import measure


def entries(run: Path) -> list[dict[str, float]]:
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [
        {k: v for k, v in json.loads(line).items() if k not in ("wall_s", "stage")}
        for line in lines
    ]


def test_a_tiny_one_learns_to_reconstruct_and_uses_its_codes(vqvae_run):
    first, *_, last = entries(vqvae_run)
    # In units of the pixels' variance: the mean image would be 1.
    assert last["train/reconstruction"] < 0.5 < first["train/reconstruction"]
    assert last["held_out/psnr_db"] > first["held_out/psnr_db"] > 10
    assert last["held_out/used"] > 0.5


def test_what_was_saved_comes_back_the_same(vqvae_run, tmp_path):
    model, vision = saved.load(vqvae_run)
    assert (vision.task, vision.camera, vision.model) == ("open_drawer", "shoulder", TINY)
    saved.save(model, vision, tmp_path / "again")
    again, same = saved.load(tmp_path / "again")
    assert same == vision and again.fingerprint() == model.fingerprint()
    files = {p.name for p in (vqvae_run / "checkpoints/last/").rglob("*") if p.is_file()}
    assert files == {"config.json", "model.safetensors", "state.json", "state.safetensors"}


class Cut(Exception):
    """Stands for a kill."""


def test_an_interrupted_run_ends_as_one_that_was_not(images, vqvae_run, tmp_path, monkeypatch):
    config = tiny_training(images, tmp_path / "run")
    done = iter(range(10**6))

    def step(*args: object, **options: object):
        if next(done) == 30:
            raise Cut
        return real(*args, **options)

    real = training.step
    with monkeypatch.context() as patch:
        patch.setattr(training, "step", step)
        with pytest.raises(Cut):
            training.train(config)
    training.train(replace(config, resume=True))
    assert entries(tmp_path / "run") == entries(vqvae_run)
    whole, resumed = saved.load(vqvae_run)[0], saved.load(tmp_path / "run")[0]
    assert resumed.fingerprint() == whole.fingerprint()


def test_a_finished_run_can_be_resumed(images, vqvae_run):
    _, quality = training.train(tiny_training(images, vqvae_run, resume=True))
    assert quality.psnr_db == pytest.approx(entries(vqvae_run)[-1]["held_out/psnr_db"], abs=1e-3)


def weights_of(run: Path) -> dict[str, torch.Tensor]:
    return saved.load(run)[0].state_dict()


def test_what_cannot_be_resumed_is_told_and_changes_nothing(images, tmp_path):
    config = tiny_training(images, tmp_path, updates=2, reader_updates=2)
    training.train(config)
    before = (tmp_path / training.CONFIG_FILE).read_text()
    with pytest.raises(DataError, match=r"cannot be resumed from: .*size mismatch"):
        training.train(replace(config, resume=True, model=replace(TINY, codes=64)))
    assert (tmp_path / training.CONFIG_FILE).read_text() == before
    training.train(replace(config, resume=True, updates=4))


def test_a_run_that_is_to_end_where_it_was_killed_still_teaches_its_reader(
    images, tmp_path, monkeypatch
):
    config = tiny_training(images, tmp_path, updates=4, validate_every=2, reader_updates=5)
    with monkeypatch.context() as patch:
        patch.setattr(reading, "learn", lambda *_: (_ for _ in ()).throw(Cut))
        with pytest.raises(Cut):
            training.train(config)
    before = weights_of(tmp_path)
    training.train(replace(config, resume=True, updates=2))
    after = weights_of(tmp_path)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("reader.") for name in changed)


def test_what_is_held_out_or_off_the_table_is_never_learned_from(images, tmp_path, monkeypatch):
    weights, load = [], training.load_frames
    for name in ("as it is", "disturbed"):

        def disturbed(config, differs=name == "disturbed"):
            frames, arrays, episodes, held = load(config)
            frames, rows = np.array(frames), rows_of(arrays, held)
            hidden = rows_of(arrays, episodes)[:20]
            goals = np.array(arrays.achieved_goal)
            goals[hidden, 2] = -1.0
            if differs:
                frames[rows] = 255 - frames[rows]
                frames[hidden] = 255 - frames[hidden]
            return frames, replace(arrays, achieved_goal=goals), episodes, held

        monkeypatch.setattr(training, "load_frames", disturbed)
        monkeypatch.setattr(reading, "learn", lambda *_: None)
        config = tiny_training(images, tmp_path / name, updates=20, validate_every=20)
        training.train(config)
        weights.append(weights_of(tmp_path / name))
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    first, second = (entries(tmp_path / name)[-1] for name in ("as it is", "disturbed"))
    assert first["held_out/psnr_db"] != second["held_out/psnr_db"]


def test_every_update_has_its_learning_rate(images, tmp_path, monkeypatch):
    rates, step = [], training.step

    def noted(model, optimizer, *rest):
        rates.append(optimizer.param_groups[0]["lr"])
        return step(model, optimizer, *rest)

    monkeypatch.setattr(training, "step", noted)
    config = tiny_training(images, tmp_path, updates=4, reader_updates=1)
    training.train(config)
    assert rates == [training.learning_rate(config, update) for update in (1, 2, 3, 4)]
    assert rates[0] > rates[1] > rates[2] > rates[3]


def test_the_quality_is_that_of_the_held_out_episodes(images, vqvae_run, monkeypatch):
    measured = []

    def noted(model, chosen):
        measured.append(chosen)
        return measure(model, chosen)

    monkeypatch.setattr(evaluate_module, "measure", noted)
    evaluate_module.evaluate(vqvae_run)
    config = tiny_training(images, vqvae_run)
    held, _ = split(4, config.validation_share, config.seed)
    rows = rows_of(load_arrays(images), held)
    np.testing.assert_array_equal(measured[0], load_images(images, "shoulder")[rows])


def test_a_vqvae_is_measured_on_data_of_its_task_only(images, vqvae_run, tmp_path):
    push4 = tmp_path / "push4"
    collect(CollectConfig(push4, task="push4", policy="random", episodes=1, workers=1))
    with pytest.raises(DataError, match="is a dataset of 'push4', the VQ-VAE was trained on"):
        evaluate_module.evaluate(vqvae_run, push4)
    single = drawn_dataset(tmp_path, episodes=1)
    with pytest.raises(DataError, match="too few episodes: 1"):
        evaluate_module.evaluate(vqvae_run, single)


def test_the_papers_preset_is_the_papers():
    config = preset("paper", Path("data"), Path("runs"))
    assert (config.lr, config.batch_size, config.updates) == (1e-4, 256, 1_000_000)
    assert config.final_lr_share == 1.0 and config.model.image_size == (48, 48)
    assert config.model.latent_channels == 3


def test_the_learning_rate_falls_to_its_share():
    config = replace(preset("cpu", Path("d"), Path("r")), updates=100, lr=1.0, final_lr_share=0.1)
    rates = [training.learning_rate(config, update) for update in (0, 50, 100)]
    assert rates == pytest.approx([1.0, 0.55, 0.1])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"batch_size": 0}, "--batch-size must be at least 1; got 0"),
        ({"validation_share": 1.0}, "--validation-share must be between 0 and 1; got 1.0"),
        ({"model": replace(TINY, image_size=(48, 50))}, "multiples of 8; got 48 x 50"),
        ({"model": replace(TINY, reading=-1.0)}, "--model.reading must be at least 0; got -1.0"),
        ({"model": replace(TINY, commitment=-1.0)}, "--model.commitment must be at least 0; got"),
        ({"final_lr_share": -1.0}, "--final-lr-share must be 0 to 1; got -1.0"),
        ({"model": replace(TINY, codes=0)}, "--model.codes must be at least 1; got 0"),
        ({"model": replace(TINY, codes=70000)}, "--model.codes must be at most 65536; got 70000"),
        ({"lr": float("nan")}, "--lr must be above 0; got nan"),
    ],
)
def test_a_setting_that_cannot_be_used_is_named(tmp_path, changes, said):
    with pytest.raises(ConfigError, match=said):
        training.train(tiny_training(tmp_path / "data", tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists()


def test_a_dataset_without_images_or_of_another_size_is_refused(images, tmp_path):
    def said(config: VqVaeTrainConfig) -> str:
        with pytest.raises(DataError) as caught:
            training.train(config)
        assert not config.output_dir.exists()
        return str(caught.value)

    states = images.parent / "states"
    assert "no images of camera 'shoulder'" in said(tiny_training(states, tmp_path / "run"))
    larger = replace(TINY, image_size=(64, 64))
    assert "are 48 x 48; the VQ-VAE takes 64 x 64" in said(
        tiny_training(images, tmp_path / "run", model=larger)
    )


def test_the_command_trains_and_evaluates(images, tmp_path, monkeypatch, capsys):
    def run(*words: object) -> str:
        monkeypatch.setattr(sys, "argv", ["eisp-vqvae", *map(str, words)])
        cli.main()
        return capsys.readouterr().out

    small = [
        "--updates", 3, "--reader-updates", 5, "--batch-size", 4,
        "--model.channels", 4, 4, "--model.codes", 8,
    ]  # fmt: skip
    place = ["--dataset.root", images, "--output-dir", tmp_path / "run", "--threads", 1]
    said = run("train", *place, *small, "--validation-share", 0.25, "--device", "cpu")
    assert "PSNR" in said and f"model: {tmp_path / 'run/checkpoints/last'}" in said
    table = run("evaluate", tmp_path / "run")
    assert "block by linear probe" in table and "handle by linear probe" in table
    assert "codes changed by video" in table
    figures = json.loads(run("evaluate", tmp_path / "run", "--json"))
    assert 0 <= figures["changed_by_video"] <= 1 and 0 < figures["quality"]["used"] <= 1
    monkeypatch.setattr(sys, "argv", ["eisp-vqvae", "train", *map(str, place)])
    with pytest.raises(SystemExit):
        cli.main()
    assert "is not empty; add --resume" in capsys.readouterr().err


def test_a_folder_that_holds_no_vqvae_is_named(tmp_path):
    with pytest.raises(DataError, match="holds no VQ-VAE"):
        saved.load(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"x")
    (tmp_path / "config.json").write_text('{"agent": {}}')
    with pytest.raises(DataError, match="holds a policy, not a VQ-VAE"):
        saved.load(tmp_path)


def test_moments_are_those_of_the_pixels():
    pixels = np.random.default_rng(0).integers(0, 256, (7, 8, 8, 3), np.uint8)
    mean, std = training.moments(pixels)
    assert np.allclose(mean.numpy(), (pixels / 255.0).mean(0), atol=1e-5)
    deviation = (pixels / 255.0).std(0)
    assert np.allclose(std.numpy(), np.sqrt((deviation**2).mean((0, 1))), atol=1e-5)
