"""A look at the words of a command line before they are parsed: where do its options start from?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from eisp_data.config import load_yaml
from eisp_data.errors import ConfigError


def take(words: Sequence[str], flag: str) -> tuple[list[str], str | None]:
    """Take ``flag VALUE`` or ``flag=VALUE`` out of the words; None if it is not there."""
    for index, word in enumerate(words):
        _, equals, value = word.partition("=")
        if _names(word, flag):
            if not equals and index + 1 == len(words):
                raise ConfigError(f"{flag}: missing its value")
            rest = [*words[:index], *words[index + (1 if equals else 2) :]]
            return rest, value if equals else words[index + 1]
    return list(words), None


def given(words: Sequence[str], flag: str) -> bool:
    """Return whether the flag is among the words, with or without a value."""
    return any(_names(word, flag) for word in words)


def _names(word: str, flag: str) -> bool:
    # The parser takes --output_dir for --output-dir.
    return word.partition("=")[0].replace("_", "-") == flag


def preset_name(value: str | None, choices: Sequence[str]) -> str:
    """Return which preset ``--preset`` names, ``cpu`` if it was left out.

    Raises:
        ConfigError: there is none of that name.
    """
    name = value or "cpu"
    if name not in choices:
        raise ConfigError(f"--preset {name}: choose one of {', '.join(choices)}")
    return name


def saved_run[T](words: Sequence[str], kind: type[T], name: str) -> T | None:
    """Return the configuration that ``--resume`` goes on with, from the ``--output-dir``.

    Returns:
        None without ``--resume``.

    Raises:
        ConfigError: there is no such run.
    """
    if not given(words, "--resume"):
        return None
    _, folder = take(words, "--output-dir")
    if folder is None:
        raise ConfigError("--resume: give --output-dir, the run to go on with")
    if not (Path(folder) / name).exists():
        raise ConfigError(f"--resume: {folder} holds no run, {name} is missing")
    return load_yaml(kind, Path(folder) / name)
