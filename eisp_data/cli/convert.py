"""``eisp-data convert``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from eisp_data.cli.progress import counting
from eisp_data.storage.mcap.convert import ConvertConfig, suggested_mapping
from eisp_data.storage.mcap.convert import convert as convert_recordings


@dataclass(frozen=True, kw_only=True)
class Convert(ConvertConfig):
    """Options of ``eisp-data convert``."""

    inputs: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP files, or folders of them (ROS 2 bags are such folders), in this order."""
    show_mapping: bool = False
    """Print the mapping that the first recording suggests, to be saved and edited; write nothing.
    """


def convert(options: tyro.conf.OmitArgPrefixes[Convert]) -> None:
    """Make a LeRobot dataset of MCAP recordings or ROS 2 bags; print what was left out."""
    if options.show_mapping:
        print(suggested_mapping(options), end="")
        return
    with counting("converting") as show:
        report = convert_recordings(options, show)
    for line in report.lines:
        print(line)
    print(f"{report.episodes} episodes, {report.frames} frames in {options.to}")
