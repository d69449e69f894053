"""Offline pretraining on a small dataset of Stack."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from learning_samples import tiny_pretraining
from safetensors.torch import load_file

import pretrain.train
from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.cache import load_arrays
from pretrain import checkpoint
from pretrain.agent import Agent
from pretrain.config import DatasetConfig
from pretrain.learner import Learner
from pretrain.replay import Trajectories
from pretrain.train import load_trajectories
from pretrain.train import pretrain as run_pretraining


class Killed(BaseException):
    """The process ends here."""


def metrics_of(run: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "wall_s"} for line in lines]


def weights_of(run: Path, step: str = "last") -> dict[str, torch.Tensor]:
    return load_file(run / "checkpoints" / step / "pretrained_model" / "model.safetensors")


def kill_after(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Let the process end just after the checkpoint of that step."""
    save = checkpoint.save

    def save_and_die(run: Path, at: int, *args: object) -> None:
        save(run, at, *args)  # type: ignore[arg-type]
        if at == step:
            raise Killed

    monkeypatch.setattr(checkpoint, "save", save_and_die)


def test_a_run_writes_a_policy_its_settings_and_its_metrics(pretrained):
    assert (pretrained / "pretrain.yaml").is_file()
    assert (pretrained / "checkpoints/last").resolve().name == "000012"
    agent = Agent.load(pretrained / "checkpoints/last/pretrained_model")
    assert agent.config.task == "stack"
    lines = metrics_of(pretrained)
    assert [line["updates"] for line in lines] == [4, 8, 12]
    said = {"log_likelihood", "reconstruction_error", "divergence", "hits", "near_data"}
    for line in lines:
        assert {f"held_out/{name}" for name in said} <= set(line)
        assert all(np.isfinite(v) for v in line.values() if isinstance(v, float))
        assert 0 <= line["held_out/hits"] <= 1 and 0 <= line["held_out/near_data"] <= 1


@pytest.mark.parametrize("step", [4, 8])
def test_a_run_that_is_killed_and_resumed_ends_like_one_that_is_not(
    pretrained, stack_dataset, tmp_path, monkeypatch, step
):
    config = tiny_pretraining(stack_dataset, tmp_path / "run")
    with monkeypatch.context() as patch:
        kill_after(patch, step)
        with pytest.raises(Killed):
            run_pretraining(config)
    torch.manual_seed(99)
    run_pretraining(replace(config, resume=True))
    assert metrics_of(tmp_path / "run") == metrics_of(pretrained)
    ours, theirs = weights_of(tmp_path / "run"), weights_of(pretrained)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs | ours)


def test_a_run_that_is_killed_before_its_first_checkpoint_starts_over(
    pretrained, stack_dataset, tmp_path, monkeypatch
):
    config = tiny_pretraining(stack_dataset, tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", lambda *_: (_ for _ in ()).throw(Killed))
        with pytest.raises(Killed):
            run_pretraining(config)
    run_pretraining(replace(config, resume=True))
    assert metrics_of(tmp_path / "run") == metrics_of(pretrained)


def test_another_seed_is_another_run(pretrained, stack_dataset, tmp_path):
    run_pretraining(tiny_pretraining(stack_dataset, tmp_path, updates=4, seed=1))
    assert metrics_of(tmp_path)[0] != metrics_of(pretrained)[0]


def test_episodes_are_held_out_whole_and_none_is_in_both_parts(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path, validation_share=0.25)
    train, held_out, _ = load_trajectories(config)
    arrays = load_arrays(stack_dataset)
    assert len(train.episode_start) - 1 == 10 and len(held_out.episode_start) - 1 == 2
    assert len(train) + len(held_out) == len(arrays.observation)

    def episodes(data: Trajectories) -> set[bytes]:
        spans = zip(data.episode_start, data.episode_start[1:], strict=False)
        return {data.observation[start:stop].tobytes() for start, stop in spans}

    starts = arrays.episode_start
    every = {arrays.observation[a:b].tobytes() for a, b in zip(starts, starts[1:], strict=False)}
    assert not episodes(train) & episodes(held_out)
    assert episodes(train) | episodes(held_out) == every
    other = load_trajectories(replace(config, seed=1))[1]
    assert episodes(other) != episodes(held_out)


def test_what_is_held_out_is_never_learned_from(stack_dataset, tmp_path, monkeypatch):
    weights = []
    for name in ("as it is", "shifted"):
        config = tiny_pretraining(stack_dataset, tmp_path / name, validate_every=12)

        def load(config, vision, shift=float(name == "shifted")):
            train, held_out, layout = load_trajectories(config)
            held_out.observation += shift
            held_out.achieved_goal += shift
            return train, held_out, layout

        monkeypatch.setattr(pretrain.train, "load_trajectories", load)
        run_pretraining(config)
        weights.append(weights_of(tmp_path / name))
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    lines = [metrics_of(tmp_path / name)[0] for name in ("as it is", "shifted")]
    assert lines[0]["held_out/log_likelihood"] != lines[1]["held_out/log_likelihood"]


def say_likelihoods(monkeypatch: pytest.MonkeyPatch, *likelihoods: float) -> None:
    """Let the validations find these, one after the other."""
    said = iter(likelihoods)

    def validate(*_: object) -> dict[str, torch.Tensor]:
        return {"log_likelihood": torch.tensor(next(said)), "near_data": torch.tensor(0.5)}

    monkeypatch.setattr(pretrain.train, "validate", validate)


def test_the_generator_of_the_best_validation_is_kept(stack_dataset, tmp_path, monkeypatch):
    config = tiny_pretraining(stack_dataset, tmp_path)
    say_likelihoods(monkeypatch, 1.0, 3.0, 2.0, 3.0)
    run_pretraining(config)
    best, last = weights_of(tmp_path, "000008"), weights_of(tmp_path)
    generator = [name for name in best if name.startswith("proposer.")]
    assert all(torch.equal(best[name], last[name]) for name in generator)
    assert any(not torch.equal(best[name], last[name]) for name in best if "sac.actor" in name)


def test_a_run_that_is_to_end_where_it_was_killed_keeps_the_best_generator(
    stack_dataset, tmp_path, monkeypatch
):
    config = tiny_pretraining(stack_dataset, tmp_path)
    say_likelihoods(monkeypatch, 3.0, 2.0, 3.0)
    with monkeypatch.context() as patch:
        kill_after(patch, 8)
        with pytest.raises(Killed):
            run_pretraining(config)
    best = weights_of(tmp_path, "000004")
    run_pretraining(replace(config, resume=True, updates=8))
    last = weights_of(tmp_path)
    assert all(torch.equal(best[k], last[k]) for k in best if k.startswith("proposer."))


def test_learning_rates_fall_to_their_shares(stack_dataset, tmp_path, monkeypatch):
    config = tiny_pretraining(
        stack_dataset, tmp_path, updates=4, final_lr_share=0.5, generator_final_lr_share=0.25
    )
    rates: list[tuple[float, float]] = []
    monkeypatch.setattr(Learner, "set_lr", lambda _, *both: rates.append(both))
    run_pretraining(config)
    shares = np.array(rates) / [config.agent.sac.lr, config.generator_lr]
    np.testing.assert_allclose(shares, [(0.75, 0.75), (0.5, 0.5), (0.5, 0.25), (0.5, 0.25)])


def test_a_run_that_diverges_is_told_and_the_checkpoint_before_is_of_use(
    stack_dataset, tmp_path, monkeypatch
):
    config = tiny_pretraining(stack_dataset, tmp_path)
    updates, seen = Learner.updates, iter(range(100))

    def diverge(learner, *args):
        for info in updates(learner, *args):
            yield info | {"critic_loss": torch.tensor(np.nan)} if next(seen) >= 6 else info

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "updates", diverge)
        with pytest.raises(DataError, match=r"critic_loss is nan after 8 updates: .* diverged"):
            run_pretraining(config)
    assert (tmp_path / "checkpoints/last").resolve().name == "000004"
    run_pretraining(replace(config, resume=True))


def test_the_papers_parts_train_as_well(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path, updates=2)
    agent = replace(config.agent, features="plain", generator="hybrid", waypoints=4)
    run = run_pretraining(replace(config, agent=agent))
    assert np.isfinite(metrics_of(run)[-1]["held_out/log_likelihood"])


def test_a_dataset_of_another_task_is_refused_and_nothing_written(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path / "run")
    config = replace(config, agent=replace(config.agent, task="push4"))
    with pytest.raises(DataError, match="is a dataset of 'stack', not of 'push4'"):
        run_pretraining(config)
    assert not (tmp_path / "run").exists()


def test_too_few_episodes_are_refused_and_nothing_written(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path / "run", validation_share=0.99)
    with pytest.raises(DataError, match="too few episodes: 12"):
        run_pretraining(config)
    assert not (tmp_path / "run").exists()


def test_a_folder_without_a_dataset_is_refused_and_nothing_written(tmp_path):
    config = tiny_pretraining(tmp_path / "nowhere", tmp_path / "run")
    with pytest.raises(DataError, match="nowhere: not a LeRobot dataset"):
        run_pretraining(replace(config, dataset=DatasetConfig(tmp_path / "nowhere")))
    assert not (tmp_path / "run").exists()


def test_a_run_does_not_mix_with_what_is_there(stack_dataset, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty; add --resume or choose another"):
        run_pretraining(tiny_pretraining(stack_dataset, tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_there_must_be_a_run_to_resume(stack_dataset, tmp_path):
    with pytest.raises(ConfigError, match=r"holds no run, pretrain\.yaml is missing"):
        run_pretraining(tiny_pretraining(stack_dataset, tmp_path, resume=True))


def test_resuming_with_other_networks_is_told_in_one_line(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path, updates=1)
    run_pretraining(config)
    sac = replace(config.agent.sac, layers=(24, 24))
    other = replace(config, agent=replace(config.agent, sac=sac), resume=True)
    before = (tmp_path / "pretrain.yaml").read_text()
    with pytest.raises(DataError, match=r"cannot be resumed from: .*size mismatch"):
        run_pretraining(other)
    # What was refused has changed nothing.
    assert (tmp_path / "pretrain.yaml").read_text() == before
    run_pretraining(replace(config, resume=True, updates=2))


def test_a_run_goes_on_with_its_dataset_alone(stack_dataset, tmp_path):
    config = tiny_pretraining(stack_dataset, tmp_path / "run", updates=1)
    run_pretraining(config)
    other = replace(config, dataset=DatasetConfig(tmp_path), resume=True)
    with pytest.raises(ConfigError, match=r"the run learns from .*stack, not from"):
        run_pretraining(other)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_gpu_that_is_not_there_is_told(stack_dataset, tmp_path):
    with pytest.raises(ConfigError, match=r"--device cuda: .* choose auto or cpu"):
        run_pretraining(tiny_pretraining(stack_dataset, tmp_path / "run", device="cuda"))
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_pretrains_a_policy_that_a_processor_reads(stack_dataset, tmp_path):
    run = run_pretraining(tiny_pretraining(stack_dataset, tmp_path, device="cuda"))
    agent = Agent.load(run / "checkpoints/last/pretrained_model")
    assert all(parameter.isfinite().all() for parameter in agent.parameters())
