"""``eisp-finetune`` and ``eisp-eval`` from the command line."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import pytest
from image_samples import skip_without_opengl

from eisp_data.config import load_yaml, save_yaml
from eisp_data.errors import ConfigError
from finetune.cli import evaluate, finetune
from finetune.config import FinetuneConfig
from pretrain.config import PretrainConfig

SMALL = [
    "--online.rounds", "1", "--online.worlds", "2", "--online.updates", "2",
    "--online.batch-size", "8", "--online.evaluation-episodes", "1",
    "--device", "cpu", "--threads", "1",
]  # fmt: skip


def run(monkeypatch: pytest.MonkeyPatch, command, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["eisp", *map(str, words)])
    command.main()


def mistake(monkeypatch, capsys, command, *words: object) -> str:
    """Return the one line that a command says before it exits with status 2."""
    with pytest.raises(SystemExit) as caught:
        run(monkeypatch, command, *words)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1
    return said


def test_a_policy_is_fine_tuned_resumed_and_evaluated(pretrained, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    run(monkeypatch, finetune, "--policy.path", pretrained, "--output-dir", folder, *SMALL)
    said = capsys.readouterr().out
    assert "success before" in said and f"policy: {folder / 'best'}" in said
    more = ["--online.rounds", "2", "--online.updates", "1"]
    run(monkeypatch, finetune, "--output_dir", folder, "--resume", *more)
    saved = load_yaml(FinetuneConfig, folder / "finetune.yaml")
    assert (saved.online.rounds, saved.online.worlds, saved.resume) == (2, 2, False)
    lines = (json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())
    assert [each["updates"] for each in lines if each["stage"] == "finetune"] == [0, 2, 3]
    capsys.readouterr()
    words = ["--policy.path", folder, "--episodes", "2", "--device", "cpu", "--threads", "1"]
    run(monkeypatch, evaluate, *words, "--json")
    figures = json.loads(capsys.readouterr().out)
    assert (figures["task"], figures["episodes"], figures["seed"]) == ("stack", 2, 1000)
    assert figures["oracle_return"] < 0 and figures["paper_return"] == -89.29
    for name in ("success_last", "success_any", "success_settled", "return", "relative_return"):
        estimate = figures[name]
        assert estimate["low"] <= estimate["mean"] <= estimate["high"]
    run(monkeypatch, evaluate, *words)
    table = capsys.readouterr().out
    assert table.startswith("stack: 2 episodes from seed 1000")
    assert all(row in table for row in ("success at the last step", "relative to the oracle"))


def test_the_figures_are_not_lost_where_there_is_no_opengl(
    pretrained, tmp_path, monkeypatch, capsys
):
    def no_opengl(width: int, height: int) -> None:
        raise ConfigError("cannot render")

    monkeypatch.setattr("eisp_data.sim.offscreen.open_gl", no_opengl)
    words = ["--policy.path", pretrained, "--episodes", "1", "--device", "cpu", "--json"]
    run(monkeypatch, evaluate, *words, "--video", tmp_path / "film.mp4")
    said = capsys.readouterr()
    assert json.loads(said.out)["episodes"] == 1
    assert said.err == "no film: cannot render\n"
    assert list(tmp_path.iterdir()) == []


def test_the_figures_are_not_lost_where_the_disk_is_full(
    pretrained, small_disk, monkeypatch, capsys
):
    skip_without_opengl()
    film = small_disk("4k") / "film.mp4"
    words = ["--policy.path", pretrained, "--episodes", "1", "--device", "cpu", "--json"]
    run(monkeypatch, evaluate, *words, "--video", film)
    said = capsys.readouterr()
    assert json.loads(said.out)["episodes"] == 1
    assert said.err.startswith("no film: ") and "No space left on device" in said.err
    assert said.err.count("\n") == 1
    assert list(film.parent.iterdir()) == []


def test_without_a_policy_it_learns_fast_and_explores(tmp_path, monkeypatch):
    monkeypatch.setattr("finetune.run._FIRST_EPISODES", 3)
    run(monkeypatch, finetune, "--env.id", "FetchReach-v4", "--output-dir", tmp_path, *SMALL)
    saved = load_yaml(FinetuneConfig, tmp_path / "finetune.yaml")
    assert (saved.online.lr, saved.online.noise, saved.online.worlds) == (1e-3, 1.0, 2)
    assert not saved.subgoals.rest_when_met


@pytest.mark.parametrize(
    ("command", "words", "said"),
    [
        (finetune, [], "give --policy.path"),
        (finetune, ["--policy.path", "nowhere"], "nowhere holds no policy"),
        (finetune, ["--policy.path", "RUN", "--online.round", "3"], "mean --online.rounds?"),
        (finetune, ["--policy.path", "RUN", "--env.id", "FetchReach-v4"], "a policy of 'stack'"),
        (finetune, ["--policy.path", "RUN", "--subgoals.source", "magic"], "magic"),
        (finetune, ["--policy.path", "RUN", "--online.worlds", "0"], "must be at least 1; got 0"),
        (finetune, ["--resume"], "--resume: give --output-dir"),
        (finetune, ["--env.id", "FetchReach-v4", "--seed", "499"], "must be 0 to 498 without a"),
        (evaluate, ["--policy.path", "RUN", "--seed", "999999"], "from 1000000 on are learned"),
        (evaluate, [], "missing --policy.path"),
        (evaluate, ["--policy.path", "nowhere"], "nowhere holds no policy"),
        (evaluate, ["--policy.path", "RUN", "--episodes", "0"], "--episodes must be at least 1"),
        (
            evaluate,
            ["--policy.path", "RUN", "--seed", "-4"],
            "--seed must be 0 to 4294967295; got -4",
        ),
        (evaluate, ["--policy.path", "RUN", "--episode", "1"], "did you mean --episodes?"),
        (evaluate, ["--policy.path", "RUN", "--seed", "9" * 23], "--seed must be 0 to 4294967295"),
        (evaluate, ["--policy.path", "RUN", "--video", "."], "--video: cannot write .: Is a dir"),
    ],
)
def test_mistakes_are_told_in_one_line(
    pretrained, tmp_path, monkeypatch, capsys, command, words, said
):
    monkeypatch.chdir(tmp_path)
    words = [str(pretrained) if word == "RUN" else word for word in words]
    assert said in mistake(monkeypatch, capsys, command, *words)
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_that_has_moved_is_asked_for(pretrained, tmp_path, monkeypatch, capsys):
    run_of = shutil.copytree(pretrained, tmp_path / "run", symlinks=True)
    config = load_yaml(PretrainConfig, run_of / "pretrain.yaml")
    assert config.dataset.root.is_absolute()
    moved = replace(config, dataset=replace(config.dataset, root=tmp_path / "moved"))
    save_yaml(moved, run_of / "pretrain.yaml")
    said = mistake(monkeypatch, capsys, finetune, "--policy.path", run_of, *SMALL)
    assert f"was pretrained on {tmp_path / 'moved'}, which is not there; give --data" in said


def test_a_policy_of_recordings_is_not_taken_for_an_environments(
    pretrained, tmp_path, monkeypatch, capsys
):
    policy = shutil.copytree(pretrained / "checkpoints/last/pretrained_model", tmp_path / "policy")
    config = (policy / "config.json").read_text()
    (policy / "config.json").write_text(config.replace('"task": "stack"', '"task": "blocks"'))
    said = mistake(monkeypatch, capsys, evaluate, "--policy.path", policy)
    assert "the policy is of 'blocks', which is no task that can be simulated here" in said


def test_help_shows_the_defaults_for_a_policy_and_for_none(monkeypatch, capsys):
    for words, rate in (([], "5e-05"), (["--env.id", "FetchReach-v4"], "0.001")):
        with pytest.raises(SystemExit):
            run(monkeypatch, finetune, *words, "--help")
        said = " ".join(capsys.readouterr().out.split())
        assert f"It falls linearly to a tenth. (default: {rate})" in said.replace("│ ", "")


@pytest.mark.parametrize("module", ["finetune", "evaluate"])
@pytest.mark.parametrize("words", [["--what"], ["--policy.path", "nowhere"]])
def test_the_process_exits_with_status_2_and_one_line(module, words):
    program = f"from finetune.cli.{module} import main; main()"
    command = [sys.executable, "-c", program, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
