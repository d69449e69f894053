"""What a run's folder says of the run."""

from dataclasses import dataclass
from pathlib import Path

from eisp_data.config import load_yaml
from eisp_data.runs.folder import begin_run


@dataclass(frozen=True)
class Data:
    root: Path


@dataclass(frozen=True)
class Config:
    data: Data
    vision: Path | None
    resume: bool


def test_the_configuration_can_be_given_back_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    begin_run(Path("run"), Config(Data(Path("data/stack")), None, resume=True), "run.yaml")
    saved = load_yaml(Config, tmp_path / "run/run.yaml")
    assert saved == Config(Data(tmp_path / "data/stack"), None, resume=False)
