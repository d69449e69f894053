"""A recording to test with, made once."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap_samples import record_session


@pytest.fixture(scope="session")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole recording of two episodes of 20 steps; not to be changed."""
    return record_session(tmp_path_factory.mktemp("session") / "run.mcap")
