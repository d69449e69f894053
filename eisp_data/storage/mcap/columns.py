"""The further columns of a recording's rows: how old each source is, what is shown again."""

from __future__ import annotations

from eisp_data.storage.mcap.collect import Source
from eisp_data.storage.mcap.mapping import EXTRA
from eisp_data.storage.mcap.sources import Recording
from eisp_data.storage.schema import AGE, INTERVENTION, REPEATED


def age_columns(sources: list[Source]) -> list[str]:
    """Return the name of the column with the age of each source, all different."""
    names: list[str] = []
    for source in sources:
        part = "" if source.stream.camera else f".{source.stream.to.split('.')[-1]}"
        name = f"{AGE}{source.stream.name}{part}"
        same = sum(other.split("#")[0] == name for other in names)
        names.append(f"{name}#{same + 1}" if same else name)
    return names


def extra_widths(recording: Recording) -> dict[str, int]:
    """Return the further columns of each row and their widths."""
    widths = dict.fromkeys(age_columns(recording.sources), 1)
    for source in recording.sources:
        if source.stream.to.startswith(EXTRA):
            name = source.stream.to.removeprefix(EXTRA)
            widths[name] = widths.get(name, 0) + len(source.names)
        elif source.stream.camera is not None:
            widths[REPEATED + source.stream.camera] = 1
    return {**widths, INTERVENTION: 1}
