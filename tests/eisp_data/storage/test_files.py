"""Small files: JSON that any reader takes, whole or not there."""

from __future__ import annotations

import json

import pytest

from eisp_data.storage.files import replace_atomically, write_json


def refuse(text: str) -> float:
    raise AssertionError(f"{text} is no JSON")


def test_what_json_has_no_number_for_becomes_null(tmp_path):
    value = {
        "a": float("nan"),
        "b": [1.5, (float("inf"), -float("inf"))],
        "c": {"d": 1, "e": "NaN"},
    }
    write_json(tmp_path / "x.json", value)
    read = json.loads((tmp_path / "x.json").read_text(), parse_constant=refuse)
    assert read == {"a": None, "b": [1.5, [None, None]], "c": {"d": 1, "e": "NaN"}}


def test_a_write_that_fails_leaves_the_file_before_and_nothing_else(tmp_path):
    (tmp_path / "x").write_text("before")

    def fail(path):
        path.write_text("half")
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        replace_atomically(tmp_path / "x", fail)
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_text() == "before"
