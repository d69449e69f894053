"""An image task from data to figures, by the commands of the state tasks."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
from image_samples import drawn_dataset, skip_without_opengl, tiny_training

from finetune.cli import evaluate, finetune
from finetune.cli import report as report_cli
from pretrain import cli as pretrain_cli

SMALL = [
    "--updates", "3", "--batch-size", "8", "--generator-batch-size", "8", "--threads", "1",
    "--device", "cpu", "--agent.sac.layers", "8", "--agent.hybrid.layers", "8", "8",
    "--validation-share", "0.25",
]  # fmt: skip
ONLINE = [
    "--online.rounds", "1", "--online.worlds", "2", "--online.updates", "2",
    "--online.batch-size", "8", "--online.evaluation-episodes", "1",
    "--device", "cpu", "--threads", "1",
]  # fmt: skip


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``images``, a dataset, and ``vqvae``, a run on it."""
    from vqvae.train import train

    skip_without_opengl()
    folder = tmp_path_factory.mktemp("image_task")
    root = drawn_dataset(folder)
    train(tiny_training(root, folder / "vqvae", updates=10, validate_every=10))
    return folder


@pytest.fixture(scope="module")
def pretrained(work: Path) -> Path:
    """The run of a tiny pretraining of OpenDrawer from images."""
    with pytest.MonkeyPatch.context() as patch:
        run(patch, pretrain_cli, *inputs(work), "--output-dir", work / "pretrained", *SMALL)
    return work / "pretrained"


def inputs(work: Path) -> list[object]:
    return ["--dataset.root", work / "images", "--vqvae.path", work / "vqvae"]


def run(patch: pytest.MonkeyPatch, command, *words: object) -> None:
    patch.setattr(sys, "argv", ["eisp", *map(str, words)])
    command.main()


def mistake(patch, capsys, command, *words: object) -> str:
    """Return the one line that a command says before it exits with status 2."""
    with pytest.raises(SystemExit) as caught:
        run(patch, command, *words)
    said = capsys.readouterr().err.splitlines()
    assert caught.value.code == 2 and said[-1].startswith("error: ")
    return said[-1]


def test_a_script_sees_no_images(pretrained, monkeypatch, capsys):
    words = ["--policy.path", pretrained, "--episodes", "1", "--subgoals.source", "oracle"]
    said = mistake(monkeypatch, capsys, evaluate, *words)
    assert "open_drawer_image has no scripted policy, or none that sees images" in said


def test_images_lead_to_figures_and_a_report(work, pretrained, tmp_path, monkeypatch, capsys):
    tuned = tmp_path / "tuned"
    run(monkeypatch, finetune, "--policy.path", pretrained, "--output-dir", tuned, *ONLINE)
    words = ["--episodes", "2", "--device", "cpu", "--threads", "1", "--json"]
    capsys.readouterr()
    run(monkeypatch, evaluate, "--policy.path", tuned, *words)
    figures = json.loads(capsys.readouterr().out)
    assert (figures["task"], figures["paper_return"]) == ("open_drawer_image", -246.91)
    assert figures["oracle_return"] > -150 and figures["success_settled"] is not None
    page = tmp_path / "page.html"
    run(monkeypatch, report_cli, "vqvae", work / "vqvae", "--policy", tuned, "--output", page)
    text = page.read_text()
    assert text.count("data:image/png") == 2 and text.count("<svg") == 2
    assert "block by linear probe" in text


def test_a_policy_carries_its_vqvae(pretrained):
    from pretrain.agent import Agent
    from pretrain.saved import find_policy
    from vqvae.saved import load

    agent = Agent.load(find_policy(pretrained))
    assert agent.vision is not None
    assert agent.vision.fingerprint() == load(pretrained.parent / "vqvae")[0].fingerprint()
    assert not any(p.requires_grad for p in agent.vision.parameters())


def test_a_run_that_is_resumed_with_another_codebook_is_refused(
    work, pretrained, tmp_path, monkeypatch, capsys
):
    from vqvae.train import train

    own = tmp_path / "run"
    shutil.copytree(pretrained, own, symlinks=True)
    other = train(
        tiny_training(work / "images", tmp_path / "other", updates=10, seed=5, validate_every=10)
    )[0]
    words = ["--output-dir", own, "--resume", "--updates", "4"]
    run(monkeypatch, pretrain_cli, *words)
    said = mistake(monkeypatch, capsys, pretrain_cli, *words, "--vqvae.path", other)
    assert "holds another codebook than the one that the run began with" in said


def test_what_does_not_go_together_is_one_line(work, pretrained, tmp_path, monkeypatch, capsys):
    def said(*words: object) -> str:
        place = ["--output-dir", tmp_path / "x", *SMALL]
        return mistake(monkeypatch, capsys, pretrain_cli, *words, *place)

    states = ["--dataset.root", work / "states", "--vqvae.path", work / "vqvae"]
    assert "no images of camera 'shoulder'" in said(*states)
    nowhere = ["--dataset.root", work / "images", "--vqvae.path", work / "nowhere"]
    assert "holds no VQ-VAE" in said(*nowhere)
    as_vqvae = ["--dataset.root", work / "images", "--vqvae.path", pretrained]
    assert "holds a policy, not a VQ-VAE" in said(*as_vqvae)
    plain = ["--dataset.root", work / "images", "--agent.task", "open_drawer_image"]
    assert "needs --vqvae.path" in said(*plain)
    assert not (tmp_path / "x").exists()


def test_a_vqvae_of_another_task_is_refused(work, stack_dataset, tmp_path, monkeypatch, capsys):
    words = ["--dataset.root", stack_dataset, "--vqvae.path", work / "vqvae"]
    said = mistake(
        monkeypatch, capsys, pretrain_cli, *words, "--output-dir", tmp_path / "x", *SMALL
    )
    assert "is a dataset of 'stack', the VQ-VAE was trained on 'open_drawer'" in said
