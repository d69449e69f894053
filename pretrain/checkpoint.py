"""Checkpoints of an agent in training, see ``eisp_data.runs.checkpoint``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eisp_data.errors import DataError
from eisp_data.runs import MODEL, checkpoint
from eisp_data.storage.files import one_line
from pretrain.agent import Agent


def save(
    run: Path,
    step: int,
    agent: Agent,
    optimizers: Mapping[str, torch.optim.Optimizer],
    rng: np.random.Generator,
    numbers: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a checkpoint of the agent; the rest is as in ``eisp_data.runs.checkpoint.save``."""
    checkpoint.save(run, step, agent.save, optimizers, rng, numbers, arrays)


def restore(
    run: Path,
    agent: Agent,
    optimizers: Mapping[str, torch.optim.Optimizer],
    rng: np.random.Generator,
) -> tuple[int, dict[str, Any], dict[str, np.ndarray]]:
    """Put agent, optimizers and generators back where the newest checkpoint left them.

    Returns:
        Its step, its numbers and its arrays.

    Raises:
        DataError: it is damaged, or of an agent made with other settings.
    """
    folder = checkpoint.newest(run)
    saved = Agent.load(folder / MODEL).state_dict()
    try:
        agent.load_state_dict(saved)
    except RuntimeError as error:
        raise DataError(f"{folder} cannot be resumed from: {one_line(error)}") from None
    return checkpoint.restore(run, optimizers, rng)
