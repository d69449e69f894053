"""Checkpoints in LeRobot's layout, that survive a kill at any moment.

``checkpoints/<step>/pretrained_model/`` is the model, ``checkpoints/<step>/training_state/`` what
is needed to go on, ``checkpoints/last`` a link to the newest. Nothing is pickled.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import load_file, save_file
from torch import Tensor

from eisp_data.errors import DataError
from eisp_data.runs import MODEL
from eisp_data.runs.disk import writing
from eisp_data.storage.files import one_line, sync

_STATE = "training_state"
_KEPT = 2


def save(
    run: Path,
    step: int,
    save_model: Callable[[Path], None],
    optimizers: Mapping[str, torch.optim.Optimizer],
    rng: np.random.Generator,
    numbers: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
) -> None:
    """Write a checkpoint beside its place, move it there, and drop all but the newest two.

    Args:
        run: the run's folder.
        step: what the checkpoint is called, and which of two is newer.
        save_model: writes the model into a folder.
        optimizers: by name; they must be made the same way again before ``restore``.
        rng: the run's generator.
        numbers: JSON values.
        arrays: whatever else must be restored.

    Raises:
        DataError: the disk is full or cannot be written to; the checkpoints before are whole.
    """
    folder = run / "checkpoints" / f"{step:06d}"
    draft = folder.with_name(f".{folder.name}.draft")
    shutil.rmtree(draft, ignore_errors=True)
    plain = {"step": step, "rng": rng.bit_generator.state, "numbers": dict(numbers)}
    tensors = {"torch_rng": torch.get_rng_state()} | _flatten(optimizers)
    if torch.cuda.is_available():
        tensors["cuda_rng"] = torch.cuda.get_rng_state()
    try:
        with writing(folder):
            save_model(draft / MODEL)
            _write_state(draft / _STATE, plain, tensors, arrays)
            for path in (draft / MODEL, draft):
                sync(path)
            shutil.rmtree(folder, ignore_errors=True)
            draft.rename(folder)
            link = folder.with_name(".last")
            link.unlink(missing_ok=True)
            link.symlink_to(folder.name)
            last = folder.with_name("last")
            if not last.is_symlink():  # a copy of the run may have made a folder of the link
                shutil.rmtree(last, ignore_errors=True)
            link.rename(last)
            sync(folder.parent)
    except DataError:
        shutil.rmtree(draft, ignore_errors=True)  # a full disk has better use for the room
        raise
    for old in _by_step(run)[:-_KEPT]:
        shutil.rmtree(old)


def restore(
    run: Path, optimizers: Mapping[str, torch.optim.Optimizer], rng: np.random.Generator
) -> tuple[int, dict[str, Any], dict[str, np.ndarray]]:
    """Put optimizers and generators back where the newest checkpoint left them.

    Returns:
        Its step, its numbers and its arrays; the model is the caller's to load.

    Raises:
        DataError: it is damaged, or of a run with other settings.
    """
    folder = newest(run)
    try:
        plain = json.loads((folder / _STATE / "state.json").read_text())
        tensors = load_file(folder / _STATE / "state.safetensors")
        _unflatten(optimizers, tensors)
        torch.set_rng_state(torch.from_numpy(tensors["torch_rng"]))
        if "cuda_rng" in tensors and torch.cuda.is_available():
            torch.cuda.set_rng_state(torch.from_numpy(tensors["cuda_rng"]))
        rng.bit_generator.state = plain["rng"]
        step, numbers = plain["step"], plain["numbers"]
    except Exception as error:  # torch and each format have errors of their own
        raise DataError(f"{folder} cannot be resumed from: {one_line(error)}") from None
    arrays = {k.removeprefix("array/"): v for k, v in tensors.items() if k.startswith("array/")}
    return step, numbers, arrays


def exists(run: Path) -> bool:
    """Return whether the run has a checkpoint."""
    return bool(_by_step(run))


def newest(run: Path) -> Path:
    """Return the folder of the newest checkpoint, whatever has become of the link to it.

    Raises:
        DataError: there is none.
    """
    folders = _by_step(run)
    if not folders:
        raise DataError(f"{run} holds no checkpoint")
    return folders[-1]


def _by_step(run: Path) -> list[Path]:
    folders = (path for path in (run / "checkpoints").glob("*") if path.name.isdigit())
    return sorted(folders, key=lambda path: int(path.name))


def _write_state(
    state: Path,
    plain: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    arrays: Mapping[str, np.ndarray],
) -> None:
    state.mkdir()
    # Contiguous and unshared, as the format wants them.
    own = {name: np.array(value.cpu().numpy(), order="C") for name, value in tensors.items()}
    others = {f"array/{name}": np.array(value, order="C") for name, value in arrays.items()}
    save_file(own | others, state / "state.safetensors")
    (state / "state.json").write_text(json.dumps(plain))
    for path in (*state.iterdir(), state):
        sync(path)


def _flatten(optimizers: Mapping[str, torch.optim.Optimizer]) -> dict[str, Tensor]:
    return {
        f"{name}/{index}/{key}": torch.as_tensor(value)
        for name, optimizer in optimizers.items()
        for index, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }


def _unflatten(
    optimizers: Mapping[str, torch.optim.Optimizer], tensors: Mapping[str, np.ndarray]
) -> None:
    for name, optimizer in optimizers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for path, value in tensors.items():
            if path.startswith(f"{name}/"):
                _, index, key = path.split("/")
                state.setdefault(int(index), {})[key] = torch.from_numpy(value)
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": state, "param_groups": groups})
