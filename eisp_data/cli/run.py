"""What every command does: parse typed options, and give a user's mistake as one line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, NoReturn, get_type_hints

from eisp_data.errors import EispError

USER_ERROR = 2


def run(
    function: Callable[[Any], Any],
    args: Sequence[str] | None = None,
    prog: str = "",
    *,
    config_file: bool = False,
    default: Any = None,
) -> Any:
    """Parse ``args`` into the options that ``function`` takes, and call it.

    Args:
        function: its one parameter, annotated, is a dataclass of options; its docstring is what
            the command's help says.
        args: words of the command line; those of the process if None.
        prog: name of the command in its help.
        config_file: offer ``--config FILE.yaml``, which starts from a saved configuration.
        default: options that the flags start from, if no file is given.

    Returns:
        What ``function`` returns.

    An ``EispError``, or a file that cannot be reached, is printed as one line on stderr, and the
    process exits with status 2.
    """
    from eisp_data.cli.parse import parse

    hints = get_type_hints(function, include_extras=True)
    hints.pop("return", None)
    [kind] = hints.values()
    try:
        options = parse(kind, args, prog or None, function.__doc__, config_file, default)
        return function(options)
    except EispError as error:
        fail(str(error))
    except OSError as error:  # a folder that may not be read, a full disk
        fail(f"{error.filename or prog}: {error.strerror or error}")
    except KeyboardInterrupt:
        sys.exit(130)


def fail(message: str) -> NoReturn:
    """Print one line and exit as after a user's mistake."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
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
