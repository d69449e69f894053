"""The words of a command line to typed options, every mistake told in one line."""

from __future__ import annotations

import contextlib
import difflib
import io
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import tyro

from eisp_data.config import load_yaml
from eisp_data.errors import ConfigError

_CONFIG_HELP = "--config FILE.yaml starts from a saved configuration; other options override it."
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_FRAME = str.maketrans("│─", " -")
"""What tyro draws boxes with, to what it draws them with where the terminal has no such letters."""
_RULE = re.compile(r"^ {2}-+ *$", re.MULTILINE)
_UNDERLINE = re.compile(r"^ -+ *$", re.MULTILINE)
_FLAG = re.compile(r"^ {2}(--[a-z][\w.-]*)", re.MULTILINE)
_MISSING = re.compile(r"^ {6}(?:-\w, )?(--?[a-z]\S*|[A-Z]\S*)", re.MULTILINE)


def parse(
    kind: Any,
    words: Sequence[str] | None = None,
    prog: str | None = None,
    about: str | None = None,
    config_file: bool = False,
    default: Any = None,
) -> Any:
    """Return the options that a command line gives.

    Args:
        kind: a dataclass, or one annotated with tyro's markers. Nested ones make dotted flags.
        words: the command line without the command; that of the process if None.
        prog: name of the command in its help.
        about: what the command does, for its help.
        config_file: offer ``--config FILE.yaml``.
        default: an instance of ``kind`` that the flags start from, if no file is given.

    Raises:
        ConfigError: an unknown or missing flag, a value that cannot be used, or a bad ``--config``.
        SystemExit: with status 0, after ``--help``.
    """
    rest = list(sys.argv[1:] if words is None else words)
    settings: dict[str, Any] = {"prog": prog, "description": about or ""}
    if default is not None:
        settings["default"] = default
    if config_file:
        settings["description"] += f"\n\n{_CONFIG_HELP}"
        rest, file = _split_config(rest)
        if file is not None:
            plain_kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
            settings["default"] = load_yaml(plain_kind, file, absent=tyro.MISSING)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            options, unknown = tyro.cli(kind, args=rest, return_unknown_args=True, **settings)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ConfigError(_one_line(said.getvalue())) from None
    if unknown:
        flags = [*_flags(kind, settings), *["--config"] * config_file, "--help"]
        raise ConfigError(_say_unknown(unknown[0], flags))
    return options


def _split_config(words: list[str]) -> tuple[list[str], Path | None]:
    """Take ``--config FILE`` out of the words."""
    for index, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name != "--config":
            continue
        if not equals:
            if index + 1 == len(words):
                raise ConfigError("--config: missing its file")
            value = words[index + 1]
        return words[:index] + words[index + (1 if equals else 2) :], Path(value)
    return words, None


def _flags(kind: Any, settings: dict[str, Any]) -> list[str]:
    """Return the flags that the help names; tyro has no other public list of them."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        tyro.cli(kind, args=["--help"], **settings)
    return _FLAG.findall(_without_frame(said.getvalue()))


def _say_unknown(word: str, flags: list[str]) -> str:
    flag = word.partition("=")[0]
    if not flag.startswith("-"):
        return f"unexpected word {word!r}; the options are {', '.join(flags)}"
    near = difflib.get_close_matches(flag, flags, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"unknown option {flag}; {hint}the options are {', '.join(flags)}"


def _one_line(box: str) -> str:
    """Condense what tyro says in a box: its title, the message, a rule, and advice."""
    title, _, body = _without_frame(box).partition("\n")
    message = _RULE.split(_UNDERLINE.sub("", body, count=1), maxsplit=1)[0]
    if "Required" in title:
        missing = _MISSING.findall(message)
        if missing:
            return f"missing {', '.join(missing)}"
    return " ".join(message.split())


def _without_frame(box: str) -> str:
    return _COLOUR.sub("", box).translate(_FRAME)
