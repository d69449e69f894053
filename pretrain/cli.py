"""``eisp-pretrain``: learn a low-level policy and a subgoal generator from a dataset, offline."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import cast, get_args

from eisp_data.cli.run import fail, run
from eisp_data.cli.words import given, preset_name, saved_run, take
from eisp_data.errors import ConfigError, EispError
from eisp_data.storage.reader import read_spec
from eisp_data.tasks.images import image_task
from pretrain.config import PretrainConfig
from pretrain.presets import PresetName, image_preset, preset
from vqvae.saved import load_config


def main() -> None:
    """Run the command."""
    try:
        words, default = _start(sys.argv[1:])
    except EispError as error:
        fail(str(error))
    run(_command, words, "eisp-pretrain", config_file=True, default=default)


def _command(config: PretrainConfig) -> None:
    """Pretrain SAC and the subgoal generator on a dataset.

    --preset {cpu,paper} chooses the hyperparameters that the other options start from.
    """
    from pretrain.train import pretrain

    print(f"policy: {pretrain(config) / 'checkpoints' / 'last'}")


def _start(words: list[str]) -> tuple[list[str], PretrainConfig | None]:
    words, name = take(words, "--preset")
    saved = saved_run(words, PretrainConfig, "pretrain.yaml")
    if saved or given(words, "--config"):
        if name is not None:
            raise ConfigError("--preset: with --resume or --config all settings come from the file")
        return words, saved
    known = cast(PresetName, preset_name(name, get_args(PresetName)))
    _, root = take(words, "--dataset.root")
    if root is None and not (given(words, "--help") or given(words, "-h")):
        raise ConfigError("missing --dataset.root, the folder of a dataset (see eisp-collect)")
    _, vqvae = take(words, "--vqvae.path")
    if root and vqvae:
        vision = load_config(Path(vqvae))
        folder = Path("runs") / f"{image_task(vision.task)}_pretrain"
        return words, image_preset(known, vision, Path(vqvae), Path(root), folder)
    task = read_spec(Path(root)).task if root else "stack"
    folder = Path("runs") / f"{task}_pretrain"
    return words, preset(known, task, Path(root or "data/stack"), folder)
