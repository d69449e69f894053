"""Command lines: typed options, and every mistake in one line."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from eisp_data.cli.parse import parse
from eisp_data.cli.run import run
from eisp_data.config import save_yaml
from eisp_data.errors import ConfigError, DataError


@dataclass(frozen=True)
class Data:
    """Data."""

    repo_id: str
    """Which one."""


@dataclass(frozen=True)
class Options:
    """Options."""

    dataset: Data
    output_dir: Path
    """Where --everything goes."""
    device: Literal["auto", "cpu"] = "auto"
    layers: tuple[int, ...] = (1, 2)
    resume: bool = False
    steps: int = 3
    extra: dict[str, int] = field(default_factory=dict)


GOOD = ["--dataset.repo-id", "a/b", "--output-dir", "out"]


def test_nested_fields_are_dotted_flags():
    options = parse(Options, [*GOOD, "--resume", "--layers", "3", "4"])
    assert options == Options(Data("a/b"), Path("out"), layers=(3, 4), resume=True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "missing --output-dir, --dataset.repo-id"),
        ([*GOOD, "--steps", "many"], "--steps"),
        ([*GOOD, "--device", "tpu"], "'auto', 'cpu'"),
        ([*GOOD, "--reusme"], "unknown option --reusme; did you mean --resume? the options are"),
        ([*GOOD, "--zzz"], "--output-dir, --device, --layers, --resume"),
        ([*GOOD, "more"], "unexpected word 'more'"),
        (["--output-dir"], "--output-dir"),
    ],
)
@pytest.mark.parametrize("columns", ["30", "200"])
def test_a_mistake_is_one_line_with_the_choices(words, message, columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(ConfigError) as caught:
        parse(Options, words)
    assert message in str(caught.value)
    for frame in "\n│─╭\x1b":
        assert frame not in str(caught.value)


def test_a_saved_configuration_is_given_back_and_flags_override_it(tmp_path):
    saved = Options(Data("a/b"), Path("out"), "cpu", (7,), steps=9)
    save_yaml(saved, tmp_path / "config.yaml")
    words = ["--config", str(tmp_path / "config.yaml")]
    assert parse(Options, words, config_file=True) == saved
    changed = parse(Options, [f"--config={tmp_path}/config.yaml", "--steps", "1"], config_file=True)
    assert changed == Options(Data("a/b"), Path("out"), "cpu", (7,), steps=1)


def test_what_a_file_leaves_out_the_command_line_must_give(tmp_path):
    file = tmp_path / "part.yaml"
    file.write_text("dataset: {repo_id: a/b}\nsteps: 5\n")
    with pytest.raises(ConfigError, match="missing --output-dir"):
        parse(Options, ["--config", str(file)], config_file=True)
    options = parse(Options, ["--config", str(file), "--output-dir", "out"], config_file=True)
    assert (options.steps, options.output_dir) == (5, Path("out"))


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (DataError("bad\ndata"), 2, "error: bad data\n"),
        (PermissionError(13, "Permission denied", "/x"), 2, "error: /x: Permission denied\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_what_goes_wrong_ends_in_one_line_and_a_status(error, status, said, capsys):
    def command(options: Options) -> None:
        """Fail."""
        raise error

    with pytest.raises(SystemExit) as stop:
        run(command, GOOD)
    assert stop.value.code == status
    assert capsys.readouterr().err == said


def test_what_is_no_users_mistake_is_not_hidden():
    def command(options: Options) -> None:
        """Fail."""
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(command, GOOD)
