"""``eisp-data info``, ``validate`` and ``repair`` of recordings, one file or a folder of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.summary import summary

Command = Callable[..., tuple[int, str, str]]


def test_a_file_without_its_end_is_summed_up_like_a_whole_one(
    session_file: Path, tmp_path: Path
) -> None:
    whole = summary(session_file)
    with McapLog(session_file) as log:
        counted = {topic: stats.count for topic, stats in log.stats().items()}
        end = log.layout.segments[-1].offset + log.layout.segments[-1].length
    assert {topic: row["messages"] for topic, row in whole["channels"].items()} == counted
    assert whole["messages"] == sum(counted.values()) and whole["problems"] == []
    cut = tmp_path / session_file.name
    cut.write_bytes(session_file.read_bytes()[:end])
    broken = summary(cut)
    assert broken.pop("problems") and broken.pop("size_mb") < whole.pop("size_mb")
    whole.pop("problems")
    assert broken == whole


def test_info_lists_the_channels_of_every_recording_in_a_folder(
    eisp_data: Command, session_file: Path, tmp_path: Path
) -> None:
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(session_file, tmp_path / name)
    status, out, _ = eisp_data("info", tmp_path)
    assert status == 0 and out.count("recording ") == 2
    assert "foxglove.CompressedImage" in out and "observation.images.top" in out
    status, out, _ = eisp_data("info", tmp_path, "--json")
    assert [facts["recording"] for facts in json.loads(out)] == ["a.mcap", "b.mcap"]


def test_a_folder_of_recordings_is_validated_whole_and_repaired_file_by_file(
    eisp_data: Command, session_file: Path, tmp_path: Path
) -> None:
    shutil.copy(session_file, tmp_path / "a.mcap")
    assert eisp_data("validate", tmp_path)[0] == 0
    (tmp_path / "b.mcap").write_bytes(session_file.read_bytes()[:-100])
    status, out, _ = eisp_data("validate", tmp_path)
    assert status == 1 and out.count("FAIL whole") == 1 and f"{tmp_path / 'b.mcap'}:" in out
    status, _, err = eisp_data("repair", tmp_path)
    assert status == 2 and "name one of its recordings: a.mcap, b.mcap" in err
    (tmp_path / "a.mcap").unlink()
    status, out, _ = eisp_data("repair", tmp_path, "--to", tmp_path / "whole.mcap")
    assert status == 0 and out.startswith("kept ")
    assert eisp_data("validate", tmp_path / "whole.mcap")[0] == 0
