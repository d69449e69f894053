"""Configurations, which are dataclasses, to plain values and back: for YAML and JSON files."""

from __future__ import annotations

import dataclasses
import types
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from eisp_data.errors import ConfigError

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Turn dataclasses into dicts, tuples into lists and paths into strings, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: to_plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def from_plain(kind: type[T], plain: Any, where: str = "") -> T:
    """Build a dataclass from what ``to_plain`` made of one.

    Keys that are left out keep their defaults. ConfigError names an unknown key and the valid ones.
    """
    return _build(kind, plain, where)


def save_yaml(config: Any, path: Path) -> None:
    """Write a configuration as YAML."""
    path.write_text(yaml.safe_dump(to_plain(config), sort_keys=False))


def load_yaml(kind: type[T], path: Path) -> T:
    """Read a configuration from YAML; ConfigError says what is wrong with it."""
    try:
        plain = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"cannot read the configuration {path}: {reason}") from None
    return _build(kind, plain, "")


def _build(kind: Any, plain: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        if not isinstance(plain, dict):
            raise ConfigError(f"{where or 'configuration'}: expected keys and values, got {plain!r}")
        hints = get_type_hints(kind)
        names = [field.name for field in dataclasses.fields(kind)]
        for key in plain:
            if key not in names:
                raise ConfigError(
                    f"unknown key {f'{where}{key}'!r}; choose one of {', '.join(names)}"
                )
        return kind(**{k: _build(hints[k], v, f"{where}{k}.") for k, v in plain.items()})  # type: ignore[operator]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if plain is None and type(None) in arguments:
            return None
        return _build(next(a for a in arguments if a is not type(None)), plain, where)
    if origin is tuple and isinstance(plain, list):
        inner = arguments[0]
        return tuple(_build(inner, item, where) for item in plain)
    if kind is Path and plain is not None:
        return Path(plain)
    if kind is float and isinstance(plain, int | str) and not isinstance(plain, bool):
        try:  # YAML reads 1e-3 as a string
            return float(plain)
        except ValueError:
            raise ConfigError(f"{where.rstrip('.')}: {plain!r} is not a number") from None
    return plain
