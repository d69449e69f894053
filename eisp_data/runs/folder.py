"""The folder of a run: new, or one to go on with."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from eisp_data.config import save_yaml
from eisp_data.errors import ConfigError
from eisp_data.runs import checkpoint


def has_progress(run: Path, resume: bool, name: str) -> bool:
    """Return whether the run has a checkpoint to go on from; a resumed one may have none yet.

    Args:
        run: the folder.
        resume: whether it is to be gone on with.
        name: of its configuration file.

    Raises:
        ConfigError: there is no such run to resume, or something is in the way of a new one.
    """
    if resume and not (run / name).exists():
        raise ConfigError(f"--resume: {run} holds no run, {name} is missing")
    if not resume and run.exists() and any(run.iterdir()):
        raise ConfigError(f"{run} is not empty; add --resume or choose another --output-dir")
    return resume and checkpoint.exists(run)


def folders_of_run(path: Path) -> tuple[Path, ...]:
    """Return the folder and those above it that may be its run: a checkpoint's model lies three
    folders deep in one."""
    return (path, *path.resolve().parents[:3])


def check_same_dataset(begun: Path, given: Path, file: Path) -> None:
    """Raise ConfigError if a run to resume learns from another dataset.

    Args:
        begun: the dataset that it began with.
        given: the one that it is to go on with.
        file: its configuration, which says the former.
    """
    if begun.resolve() != given.resolve():
        raise ConfigError(
            f"--resume: the run learns from {begun}, not from {given}; if the dataset has moved, "
            f"say so in {file}"
        )


def begin_run(run: Path, config: Any, name: str) -> None:
    """Make the folder of a run and write its configuration, once all input has proved usable.

    Given back with ``--config``, from anywhere, it begins a run of its own on the same data: paths
    are saved as absolute ones, and not whether the run was resumed.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        save_yaml(_absolute(replace(config, resume=False)), run / name)
    except OSError as error:
        raise ConfigError(f"cannot write to {run}: {error.strerror}") from None


def _absolute(value: Any) -> Any:
    """Return a configuration with its paths made absolute."""
    if is_dataclass(value) and not isinstance(value, type):
        changed = {one.name: _absolute(getattr(value, one.name)) for one in fields(value)}
        return replace(value, **changed)
    return value.absolute() if isinstance(value, Path) else value
