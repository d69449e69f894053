"""Episodes to and from LeRobot v3 datasets: the public face of the storage."""

from __future__ import annotations

from eisp_data.storage.reader import read_episodes, read_recipe, read_spec
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.writer import DatasetWriter

__all__ = ["DatasetSpec", "DatasetWriter", "read_episodes", "read_recipe", "read_spec"]
