"""What every command does: parse typed options, and give a user's mistake as one line."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NoReturn, get_type_hints

from eisp_data.cli.parse import parse
from eisp_data.errors import EispError

USER_ERROR = 2


def run(
    function: Callable[[Any], Any],
    args: Sequence[str] | None = None,
    prog: str | None = None,
    config_file: bool = False,
    default: Any = None,
) -> Any:
    """Parse ``args`` (the command line, if left out) into ``function``'s options and call it.

    Args:
        function: takes one dataclass of options, whose fields become the flags; its docstring is
            the command's help.
        args: words of the command line.
        prog: name of the command in its help.
        config_file: offer ``--config FILE.yaml``, which starts from a saved configuration.
        default: options that the flags start from, if no file is given.

    Returns:
        What ``function`` returns.

    An ``EispError`` is printed as one line on stderr, and the process exits with status 2.
    """
    hints = get_type_hints(function, include_extras=True)
    hints.pop("return", None)
    (kind,) = hints.values()
    try:
        return function(parse(kind, args, prog, inspect.getdoc(function), config_file, default))
    except EispError as error:
        fail(str(error))
    except BrokenPipeError:  # whoever read the output, ``head`` for example, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + 13)
    except OSError as error:  # a folder that cannot be read, a full disk
        fail(f"{error.filename or prog}: {error.strerror or error}")
    except KeyboardInterrupt:
        sys.exit(130)


def fail(message: str) -> NoReturn:
    """Print one line and exit as after a user's mistake."""
    line = " ".join(message.split())
    print(f"error: {line}", file=sys.stderr)
    sys.exit(USER_ERROR)


def dispatch(prog: str, about: str, commands: Mapping[str, tuple[str, str]]) -> Any:
    """Run the subcommand that the command line names; only its module is imported.

    Args:
        prog: name of the command.
        about: one line on it.
        commands: name to (``module:function``, one line on it).
    """
    args = sys.argv[1:]
    if not args or args[0] in ("-h", "--help"):
        width = max(map(len, commands))
        print(f"usage: {prog} COMMAND [OPTIONS]\n\n{about}\n\ncommands:")
        for name, (_, line) in commands.items():
            print(f"  {name:{width}}  {line}")
        print(f"\n{prog} COMMAND --help shows the options of a command.")
        sys.exit(0 if args else USER_ERROR)
    if args[0] not in commands:
        fail(f"unknown command {args[0]!r}; choose one of {', '.join(commands)}")
    module, function = commands[args[0]][0].split(":")
    return run(getattr(import_module(module), function), args[1:], f"{prog} {args[0]}")
