"""``eisp-finetune``: learn online, with subgoals, in simulated worlds."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from eisp_data.cli.run import fail, run
from eisp_data.cli.words import given, saved_run, take
from eisp_data.errors import EispError
from finetune.config import FinetuneConfig, from_nothing
from pretrain.presets import preset
from pretrain.saved import saved_subgoals


def main() -> None:
    """Run the command."""
    try:
        default = _start(sys.argv[1:])
    except EispError as error:
        fail(str(error))
    run(_command, None, "eisp-finetune", config_file=True, default=default)


def _command(config: FinetuneConfig) -> None:
    """Fine-tune a pretrained policy online, with subgoals.

    --subgoals.source random and --subgoals.source none show what the subgoals are worth. Without a
    policy (--env.id alone) it begins with all of the noise and a learning rate of 1e-3.
    """
    from finetune.run import finetune

    summary = finetune(config)
    steps = summary["recovery_steps"]
    recovery = f"recovered after {steps:.0f} steps" if math.isfinite(steps) else "not recovered"
    print(
        f"success before {summary['offline_success']:.2f}; "
        f"deepest dip {summary['dip']:.2f}, {recovery}"
    )
    print(f"policy: {config.output_dir / 'best'}, success {summary['best_success']:.3f}")


def _start(words: list[str]) -> FinetuneConfig | None:
    saved = saved_run(words, FinetuneConfig, "finetune.yaml")
    if saved or given(words, "--config"):
        return saved
    _, path = take(words, "--policy.path")
    folder = Path("runs/finetune")
    if path is not None:
        return FinetuneConfig(folder, subgoals=saved_subgoals(Path(path)))
    _, env_id = take(words, "--env.id")
    if env_id is not None:
        return from_nothing(folder, preset("cpu", env_id, Path(), folder).agent)
    return FinetuneConfig(folder)
