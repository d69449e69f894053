"""``eisp-data info`` and ``eisp-data validate``."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from eisp_data.errors import DataError
from eisp_data.storage.files import json_text


@dataclass(frozen=True)
class Info:
    """Options of ``eisp-data info``."""

    path: tyro.conf.Positional[Path]
    """The dataset's folder."""
    json: bool = False
    """Print it as JSON."""


@dataclass(frozen=True)
class Validate:
    """Options of ``eisp-data validate``."""

    path: tyro.conf.Positional[Path]
    """A dataset's folder or an MCAP file."""


def info(options: tyro.conf.OmitArgPrefixes[Info]) -> None:
    """Print what a dataset holds: task, shapes, sizes, success, recipe."""
    from eisp_data.storage.summary import summary

    facts = summary(options.path)
    if options.json:
        print(json_text(facts))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        text = json.dumps(value, ensure_ascii=False) if isinstance(value, dict | list) else value
        print(f"{name:{width}}  {text}")


def validate(options: tyro.conf.OmitArgPrefixes[Validate]) -> None:
    """Run every check and print each with its result; exit with status 1 if one failed."""
    from eisp_data.storage import checks

    if options.path.is_dir():
        from eisp_data.storage.validate import validate as check_dataset

        results = check_dataset(options.path)
    elif options.path.is_file():
        from eisp_data.storage.mcap.check import checks as check_recording

        results = check_recording(options.path)
    else:
        raise DataError(f"{options.path}: no such file or folder")
    print("\n".join(checks.table(results)))
    failed = sum(not check.passed for check in results)
    warned = sum(check.passed and check.warning for check in results)
    print(f"{len(results)} checks, {failed} failed, {warned} to look at")
    if failed:
        sys.exit(1)
