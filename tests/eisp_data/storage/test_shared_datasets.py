"""``datasets/``: the recipes load, and the sample is sound, small and replays."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import pytest

from eisp_data.cli.collect import CollectConfig
from eisp_data.config import load_yaml
from eisp_data.policies.registry import DEMONSTRATOR
from eisp_data.replay import replay
from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import read_episodes, read_spec
from eisp_data.storage.validate import validate
from eisp_data.tasks.registry import TASKS, get_task

DATASETS = Path(__file__).parents[3] / "datasets"
SAMPLE = DATASETS / "sample"


def test_the_folder_hides_no_package():
    """With an ``__init__.py`` it would shadow Hugging Face's ``datasets``."""
    assert not list(DATASETS.rglob("__init__.py"))


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_a_recipe_a_card_and_expected_statistics(name):
    config = load_yaml(CollectConfig, DATASETS / f"{name}.yaml")
    assert config.task == name
    expected = json.loads((DATASETS / f"{name}.json").read_text())
    assert expected["instruction"] == get_task(name).instruction
    # The paper's condition on its demonstrations (appendix): at most 10% succeed.
    assert 10 * expected["success_at_any"] <= expected["episodes"]
    card = (DATASETS / f"{name}.md").read_text()
    assert get_task(name).instruction in card and f"({name}.png)" in card


@pytest.mark.parametrize("name", TASKS)
def test_what_a_recipe_gives_was_measured_with_the_demonstrator_of_today(name):
    """If not, ``python datasets/refresh.py`` measures it anew."""
    expected = json.loads((DATASETS / f"{name}.json").read_text())
    assert expected["recipe"]["noise"] == asdict(DEMONSTRATOR[name])


def test_the_sample_is_sound_and_small():
    assert all(check.passed for check in validate(SAMPLE))
    size = sum(path.stat().st_size for path in SAMPLE.rglob("*") if ".cache" not in path.parts)
    assert size < 1_000_000
    assert all(episode.success[-1] for episode in read_episodes(SAMPLE, images=True))


def test_the_sample_replays():
    """Within rounding: another processor may add in another order."""
    assert all(found.one_step < 1e-6 for found in replay(SAMPLE))


def test_the_sample_loads_for_training(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "sample", ignore=shutil.ignore_patterns(".cache"))
    arrays = load_arrays(tmp_path / "sample")
    assert arrays.spec == read_spec(SAMPLE)
    assert arrays.num_steps == sum(map(len, read_episodes(SAMPLE)))
