"""``eisp-pretrain`` from the command line: what works, and mistakes in one line."""

import subprocess
import sys
from pathlib import Path

import pytest

from pretrain.cli import main

SMALL = [
    "--updates", "2", "--batch-size", "8", "--generator-batch-size", "8", "--threads", "1",
    "--device", "cpu", "--agent.sac.layers", "8", "--agent.movers.width", "8",
]  # fmt: skip


def run(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["eisp-pretrain", *map(str, words)])
    main()


def mistake(monkeypatch, capsys, *words: object) -> str:
    """Return the one line that a command says before it exits with status 2."""
    with pytest.raises(SystemExit) as caught:
        run(monkeypatch, *words)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1
    return said


def test_a_policy_is_made_and_its_place_said(stack_dataset, tmp_path, monkeypatch, capsys):
    root = ["--dataset.root", stack_dataset, "--output-dir", tmp_path / "run"]
    run(monkeypatch, *root, *SMALL)
    said = capsys.readouterr().out
    assert "networks on 1 thread" in said
    assert f"policy: {tmp_path / 'run/checkpoints/last'}" in said
    assert "is not empty; add --resume" in mistake(monkeypatch, capsys, *root, *SMALL)
    # A resumed run keeps its settings, and takes others from the command line.
    run(monkeypatch, "--output-dir", tmp_path / "run", "--resume", "--updates", "3")
    saved = (tmp_path / "run/pretrain.yaml").read_text()
    assert "updates: 3" in saved and "batch_size: 8" in saved
    assert (tmp_path / "run/checkpoints/000003").is_dir()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "missing --dataset.root"),
        (["--dataset.root", "nowhere"], "nowhere: not a LeRobot dataset"),
        (["--dataset.root", "DATA", "--preset", "gpu"], "--preset gpu: choose one of cpu, paper"),
        (["--dataset.root", "DATA", "--batchsize", "3"], "did you mean --batch-size?"),
        (["--dataset.root", "DATA", "--updates", "many"], "many"),
        (["--dataset.root", "DATA", "--updates", "-1"], "--updates must be at least 1; got -1"),
        (["--dataset.root", "DATA", "--agent.task", "push4"], "a dataset of 'stack', not of"),
        (["--config", "mine.yaml", "--preset", "paper"], "--preset: with --resume or --config"),
        (["--resume"], "--resume: give --output-dir"),
        (["--resume", "--output-dir", "nowhere"], "nowhere holds no run"),
    ],
)
def test_mistakes_are_told_in_one_line(stack_dataset, tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    words = [str(stack_dataset) if word == "DATA" else word for word in words]
    assert said in mistake(monkeypatch, capsys, *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs a folder that none can write to")
def test_a_folder_that_cannot_be_written_is_told(stack_dataset, monkeypatch, capsys):
    words = ["--dataset.root", stack_dataset, "--output-dir", "/proc/run", *SMALL]
    assert "cannot write to /proc/run" in mistake(monkeypatch, capsys, *words)


def test_the_process_exits_with_status_2_and_one_line():
    command = [sys.executable, "-c", "from pretrain.cli import main; main()", "--what"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
