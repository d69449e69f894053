"""``eisp-data repair`` and ``eisp-data merge``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from eisp_data.errors import DataError


@dataclass(frozen=True)
class Repair:
    """Options of ``eisp-data repair``."""

    path: tyro.conf.Positional[Path]
    """A dataset's folder, an MCAP file, or the folder of one; it is only read."""
    to: Path | None = None
    """Where the whole copy goes; beside the original if left out."""
    in_place: bool = False
    """Give the copy of a dataset the original's name; the original becomes ``<name>.damaged``."""


@dataclass(frozen=True)
class Merge:
    """Options of ``eisp-data merge``."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """The datasets' folders, in this order; one alone is packed into large files."""
    to: Path
    """Folder of the new dataset."""


def repair(options: tyro.conf.OmitArgPrefixes[Repair]) -> None:
    """Make a whole copy of a damaged dataset or recording; print what was kept and lost."""
    from eisp_data.storage.mcap.repair import repair as repair_recording
    from eisp_data.storage.mcap.summary import recordings
    from eisp_data.storage.repair import repair as repair_dataset

    files = recordings(options.path)
    if files and options.in_place:
        raise DataError("--in-place is for datasets; a recording is repaired into a copy")
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise DataError(f"{options.path}: name one of its recordings: {names}")
    report = (
        repair_recording(files[0], options.to)
        if files
        else repair_dataset(options.path, options.to, options.in_place)
    )
    print("\n".join(report.lines()))


def merge(options: tyro.conf.OmitArgPrefixes[Merge]) -> None:
    """Put the episodes of several datasets of one task into a new one."""
    from eisp_data.storage.merge import merge as merge_datasets

    count = merge_datasets(options.paths, options.to)
    print(f"{count} episodes in {options.to}")
