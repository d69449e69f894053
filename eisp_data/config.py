"""Configurations, which are dataclasses, to plain values and back: for YAML and JSON files."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import yaml

from eisp_data.errors import ConfigError

_PLAIN = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def to_plain(value: Any) -> Any:
    """Turn dataclasses into dicts, tuples into lists and paths into strings, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: to_plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def from_plain[T](kind: type[T], plain: Any, where: str = "", absent: Any = None) -> T:
    """Build a dataclass from what ``to_plain`` made of one.

    Args:
        kind: the dataclass.
        plain: keys and values; a key that is left out keeps its default.
        where: what to call it in errors, for example ``agent.``.
        absent: stands in for keys without a default that are left out; None makes them an error.

    Raises:
        ConfigError: a key is unknown (it names the valid ones) or missing, or a value is of the
            wrong type.
    """
    return _build(kind, plain, where, absent)


def save_yaml(config: Any, path: Path) -> None:
    """Write a configuration as YAML."""
    path.write_text(yaml.safe_dump(to_plain(config), sort_keys=False))


def load_yaml[T](kind: type[T], path: Path, absent: Any = None) -> T:
    """Read a configuration from YAML, as ``from_plain``; ConfigError says what is wrong with it."""
    try:
        plain = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ConfigError(f"cannot read the configuration {path}: {reason}") from None
    try:
        return _build(kind, plain, "", absent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def at_least(least: int, options: Mapping[str, float | None]) -> None:
    """Raise ConfigError, naming the option, unless each that is given is finite and at least
    this."""
    for flag, value in options.items():
        if value is not None and not least <= value < float("inf"):
            raise ConfigError(f"{flag} must be at least {least}; got {value}")


def check_seed(seed: int) -> None:
    """Raise ConfigError unless every generator of random numbers takes the seed."""
    if not 0 <= seed < 2**32:
        raise ConfigError(f"--seed must be 0 to {2**32 - 1}; got {seed}")


def above_zero(options: Mapping[str, float]) -> None:
    """Raise ConfigError, naming the option, unless each is a finite number above 0."""
    for flag, value in options.items():
        if not 0 < value < float("inf"):
            raise ConfigError(f"{flag} must be above 0; got {value}")


def zero_to_one(options: Mapping[str, float]) -> None:
    """Raise ConfigError, naming the option, unless each is 0 to 1."""
    for flag, value in options.items():
        if not 0 <= value <= 1:
            raise ConfigError(f"{flag} must be 0 to 1; got {value}")


def _build(kind: Any, plain: Any, where: str, absent: Any) -> Any:
    """Return ``plain`` as a value of the type ``kind``; ``where`` ends in a dot if anything."""
    if kind is Any or (absent is not None and plain is absent):
        return plain
    if dataclasses.is_dataclass(kind):
        return _build_dataclass(kind, plain, where, absent)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _build_union(arguments, plain, where, absent)
    if origin is Literal:
        if plain in arguments:
            return plain
        raise _wrong(where, plain, f"one of {', '.join(map(str, arguments))}")
    if origin in (tuple, list):
        return _build_sequence(origin, arguments, plain, where, absent)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(plain, dict):
            raise _wrong(where, plain, "keys and values")
        return {key: _build(arguments[1], v, f"{where}{key}.", absent) for key, v in plain.items()}
    if kind is Path and isinstance(plain, str):
        return Path(plain)
    if kind is float and isinstance(plain, int | str) and not isinstance(plain, bool):
        try:  # YAML reads 1e-3 as a text
            return float(plain)
        except ValueError:
            raise _wrong(where, plain, "a number") from None
    # A bool is an int to Python, but not to whoever wrote the file.
    if not isinstance(plain, kind) or (isinstance(plain, bool) and kind is not bool):
        raise _wrong(where, plain, _PLAIN.get(kind, f"a {kind.__name__}"))
    return plain


def _build_dataclass(kind: Any, plain: Any, where: str, absent: Any) -> Any:
    if not isinstance(plain, dict):
        raise _wrong(where, plain, "keys and values")
    hints = get_type_hints(kind)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for key in plain:
        if key not in fields:
            raise ConfigError(f"unknown key {f'{where}{key}'!r}; choose one of {', '.join(fields)}")
    values = {key: _build(hints[key], v, f"{where}{key}.", absent) for key, v in plain.items()}
    for key, field in fields.items():
        if key in plain or not _is_required(field):
            continue
        if absent is None:
            raise ConfigError(f"missing key {f'{where}{key}'!r}")
        values[key] = absent
        if dataclasses.is_dataclass(hints[key]):
            values[key] = _build(hints[key], {}, f"{where}{key}.", absent)
    return kind(**values)


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING


def _build_union(arguments: tuple[Any, ...], plain: Any, where: str, absent: Any) -> Any:
    """Return the value as the first type that takes it."""
    if plain is None and type(None) in arguments:
        return None
    failure = _wrong(where, plain, "a value")
    for argument in arguments:
        if argument is not type(None):
            try:
                return _build(argument, plain, where, absent)
            except ConfigError as error:
                failure = error
    raise failure


def _build_sequence(
    origin: Any, arguments: tuple[Any, ...], plain: Any, where: str, absent: Any
) -> Any:
    if not isinstance(plain, list | tuple):
        raise _wrong(where, plain, "a list")
    if origin is tuple and arguments[-1] is not Ellipsis:
        if len(plain) != len(arguments):
            raise _wrong(where, plain, f"a list of {len(arguments)}")
        kinds: Any = arguments
    else:
        kinds = (arguments[0],) * len(plain)
    return origin(_build(k, item, where, absent) for k, item in zip(kinds, plain, strict=True))


def _wrong(where: str, plain: Any, expected: str) -> ConfigError:
    return ConfigError(
        f"{where.rstrip('.') or 'configuration'}: expected {expected}; got {plain!r}"
    )
