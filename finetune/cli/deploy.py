"""``eisp-deploy``: a policy on a robot."""

from __future__ import annotations

import sys
from pathlib import Path

from eisp_data.cli.run import fail, run
from eisp_data.cli.words import take
from eisp_data.errors import EispError
from finetune.config import PolicyConfig
from finetune.deploy_config import DeployConfig
from pretrain.saved import saved_subgoals


def main() -> None:
    """Run the command."""
    default = None
    try:
        words, path = take(sys.argv[1:], "--policy.path")
        _, folder = take(words, "--output-dir")
        if path is not None and folder is not None:
            default = DeployConfig(
                output_dir=Path(folder),
                policy=PolicyConfig(Path(path)),
                subgoals=saved_subgoals(Path(path)),
            )
    except EispError as error:
        fail(str(error))
    run(_command, None, "eisp-deploy", default=default)


def _command(config: DeployConfig) -> None:
    """Run a policy on a robot, or on its twin; record it, and draw what happened."""
    from finetune.deploy import deploy

    sys.exit(deploy(config).exit_status)


if __name__ == "__main__":
    main()
