"""``eisp-pretrain``: learn a low-level policy and a subgoal generator from a dataset, offline."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from eisp_data.cli.run import fail, run
from eisp_data.errors import ConfigError, EispError

if TYPE_CHECKING:
    from pretrain.train import PretrainConfig


def main() -> None:
    """Run the command."""
    words = sys.argv[1:]
    try:
        words, name = take(words, "--preset", "cpu")
        default = None
        if "--config" not in {word.partition("=")[0] for word in words}:
            default = _preset(name, words)
    except EispError as error:
        fail(str(error))
    from pretrain.train import PretrainConfig, pretrain

    def command(config: PretrainConfig) -> None:
        """Pretrain SAC and the subgoal generator on a dataset.

        --preset {cpu,paper} chooses the hyperparameters that the other options start from.
        """
        folder = pretrain(config)
        print(f"policy: {folder / 'checkpoints' / 'last'}")

    command.__annotations__["config"] = PretrainConfig
    run(command, words, "eisp-pretrain", config_file=True, default=default)


def take(words: list[str], flag: str, otherwise: str) -> tuple[list[str], str]:
    """Take ``flag VALUE`` or ``flag=VALUE`` out of the words of a command line."""
    for index, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name == flag:
            if not equals and index + 1 == len(words):
                raise ConfigError(f"{flag}: missing its value")
            rest = words[:index] + words[index + (1 if equals else 2) :]
            return rest, value if equals else words[index + 1]
    return words, otherwise


def _preset(name: str, words: list[str]) -> PretrainConfig:
    from eisp_data.storage.reader import read_spec
    from pretrain.presets import PresetName, preset

    if name not in get_args(PresetName):
        raise ConfigError(f"--preset {name}: choose one of {', '.join(get_args(PresetName))}")
    _, root = take(words, "--dataset.root", "")
    asked_for_help = {"-h", "--help"} & set(words)
    if not root and not asked_for_help:
        raise ConfigError("missing --dataset.root, the folder of a dataset (see eisp-collect)")
    task = read_spec(Path(root)).task if root else "stack"
    output_dir = Path("runs") / f"{task}_pretrain"
    return preset(cast(PresetName, name), task, Path(root or "data/stack"), output_dir)
