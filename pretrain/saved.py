"""Policies on the disk, as far as they can be read without torch."""

from __future__ import annotations

import json
from pathlib import Path

from eisp_data.config import from_plain
from eisp_data.errors import DataError
from eisp_data.runs import MODEL
from pretrain.config import SubgoalConfig

POLICY = MODEL


def find_policy(path: Path) -> Path:
    """Return the folder of the policy for a path that names it, its checkpoint or its run.

    Of a fine-tuned run that is the best policy, of a pretrained one the last.
    """
    places = (path, path / POLICY, path / "best" / POLICY, path / "checkpoints" / "last" / POLICY)
    for folder in places:
        if (folder / "model.safetensors").exists():
            return folder
    raise DataError(
        f"{path} holds no policy; give a run, a checkpoint, or a folder with model.safetensors"
    )


def saved_subgoals(path: Path) -> SubgoalConfig:
    """Return how a policy on the disk chooses its subgoals."""
    try:
        plain = json.loads((find_policy(path) / "config.json").read_text())
        return from_plain(SubgoalConfig, plain["agent"]["subgoals"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} holds no readable policy: {error}") from None
