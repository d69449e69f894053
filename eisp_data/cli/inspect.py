"""``eisp-data info`` and ``eisp-data validate``."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from eisp_data.storage.files import json_text


@dataclass(frozen=True)
class Info:
    """Options of ``eisp-data info``."""

    path: tyro.conf.Positional[Path]
    """A dataset's folder, an MCAP file, or a folder of them (a ROS 2 bag)."""
    json: bool = False
    """Print it as JSON."""


@dataclass(frozen=True)
class Validate:
    """Options of ``eisp-data validate``."""

    path: tyro.conf.Positional[Path]
    """A dataset's folder, an MCAP file, or a folder of them (a ROS 2 bag)."""


def info(options: tyro.conf.OmitArgPrefixes[Info]) -> None:
    """Print what a dataset or a recording holds: task, shapes, sizes, success, channels."""
    from eisp_data.storage.mcap.summary import recordings
    from eisp_data.storage.mcap.summary import summary as of_recording
    from eisp_data.storage.summary import summary as of_dataset

    files = recordings(options.path)
    found = [of_recording(file) for file in files] or [of_dataset(options.path)]
    if options.json:
        print(json_text(found if len(found) > 1 else found[0]))
        return
    print("\n\n".join("\n".join(_table(facts)) for facts in found))


def _table(facts: Mapping[str, Any]) -> list[str]:
    """Return names and values as aligned lines; a table within has lines of its own."""
    width = max(map(len, facts))
    lines = []
    for name, value in facts.items():
        if isinstance(value, dict) and value and all(isinstance(v, dict) for v in value.values()):
            rows = [[key, *map(str, row.values())] for key, row in value.items()]
            rows.insert(0, ["", *next(iter(value.values()))])
            widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
            lines.append(name)
            lines += ["  " + "  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        else:
            text = (
                json.dumps(value, ensure_ascii=False) if isinstance(value, dict | list) else value
            )
            lines.append(f"{name:{width}}  {text}")
    return lines


def validate(options: tyro.conf.OmitArgPrefixes[Validate]) -> None:
    """Run every check and print each with its result; exit with status 1 if one failed."""
    from eisp_data.storage import checks
    from eisp_data.storage.mcap.check import checks as check_recording
    from eisp_data.storage.mcap.summary import recordings
    from eisp_data.storage.validate import validate as check_dataset

    results = []
    files = recordings(options.path)
    for path in files or [options.path]:
        if len(files) > 1:
            print(f"{path}:")
        found = check_recording(path) if files else check_dataset(path)
        print("\n".join(checks.table(found)))
        results += found
    failed = sum(not check.passed for check in results)
    warned = sum(check.passed and check.warning for check in results)
    print(f"{len(results)} checks, {failed} failed, {warned} to look at")
    if failed:
        sys.exit(1)
