"""Small files: JSON that any reader takes, whole or not there."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import save_file

from eisp_data.errors import DataError
from eisp_data.storage.files import (
    WriterLock,
    make_partial,
    no_writer,
    replace_atomically,
    write_json,
)


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


def test_a_file_may_be_read_by_whom_the_umask_lets_whoever_wrote_it(tmp_path):
    replace_atomically(tmp_path / "x", lambda path: save_file({"a": np.zeros(3)}, path))
    (tmp_path / "y").touch()
    assert (tmp_path / "x").stat().st_mode == (tmp_path / "y").stat().st_mode


def test_a_write_that_fails_leaves_the_file_before_and_nothing_else(tmp_path):
    (tmp_path / "x").write_text("before")

    def fail(path):
        path.write_text("half")
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        replace_atomically(tmp_path / "x", fail)
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x").read_text() == "before"


def test_what_killed_processes_have_left_beside_a_folder_is_removed_when_it_is_made_anew(tmp_path):
    work = """
import os, pathlib, sys
from eisp_data.storage.files import make_partial
for name in ("wanted", "other"):
    (make_partial(pathlib.Path(sys.argv[1]) / name) / "half").touch()
os.kill(os.getpid(), 9)
"""
    subprocess.run([sys.executable, "-c", work, str(tmp_path)], check=False)
    ours = make_partial(tmp_path / "wanted")
    beside = make_partial(tmp_path / "wanted")
    left = {path for path in tmp_path.iterdir() if path.name.startswith(".other.")}
    assert len(left) == 1
    assert set(tmp_path.iterdir()) == {ours, beside} | left
    os.rename(ours, tmp_path / "wanted")


def test_a_folder_that_cannot_be_written_needs_no_lock(tmp_path, monkeypatch):
    with no_writer(tmp_path), pytest.raises(DataError, match="another writer"):
        WriterLock(tmp_path)
    monkeypatch.setattr(os, "access", lambda folder, how: (folder, how) != (tmp_path, os.W_OK))
    with no_writer(tmp_path):
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (errno.ENOLCK, "cannot be locked against a second writer (No locks available)"),
        (errno.EOPNOTSUPP, "cannot be locked against a second writer (Operation not supported)"),
        (errno.EACCES, "process unknown is writing this dataset"),
    ],
)
def test_a_disk_without_locks_is_not_taken_for_a_second_writer(tmp_path, monkeypatch, code, said):
    def refuse(*_words):
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(fcntl, "lockf", refuse)
        with pytest.raises(DataError) as caught:
            WriterLock(tmp_path)
    assert said in str(caught.value)
    WriterLock(tmp_path).release()
