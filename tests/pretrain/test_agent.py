"""Agents on the disk: what is read is what was written, and what is damaged is named."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from learning_samples import make_agent, scene, small

from eisp_data.errors import ConfigError, DataError
from eisp_data.tasks.registry import TASKS
from pretrain.agent import Agent
from pretrain.config import AgentConfig
from pretrain.layout import Layout
from pretrain.saved import find_policy, saved_subgoals

FILES = ("config.json", "model.safetensors")


def stack_agent(**changes: str) -> Agent:
    config = replace(small(AgentConfig("stack")), **changes)  # type: ignore[arg-type]
    return make_agent(config, Layout.of(TASKS["stack"]))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    stack_agent().save(tmp_path / "policy")
    return tmp_path / "policy"


@pytest.mark.parametrize("features", ["objects", "plain"])
@pytest.mark.parametrize("generator", ["movers", "hybrid"])
def test_an_agent_that_was_saved_does_the_same(tmp_path, features, generator):
    agent = stack_agent(features=features, generator=generator)
    agent.save(tmp_path)
    again = Agent.load(tmp_path)
    assert again.config == agent.config and again.layout == agent.layout
    observation, goal = scene("stack", 9)
    answers = []
    for each in (agent, again):
        torch.manual_seed(1)
        answers.append(
            [
                each.sac.act(observation, goal, 1.0),
                each.sac.value(observation, goal),
                *each.proposer.propose(observation, goal, 7),
                each.bank,
            ]
        )
    assert all(torch.equal(a, b) for a, b in zip(*answers, strict=True))


def test_an_agent_of_another_environment_survives_as_well(tmp_path):
    config = replace(small(AgentConfig("Reach-v0")), features="plain", generator="hybrid")
    make_agent(config, Layout(5, 2, 3)).save(tmp_path)
    assert Agent.load(tmp_path).layout == Layout(5, 2, 3)


def test_a_policy_is_two_files_and_neither_is_pickled(saved):
    assert sorted(path.name for path in saved.iterdir()) == sorted(FILES)
    content = (saved / "model.safetensors").read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    assert {entry["dtype"] for entry in header.values()} <= {"F32", "I64"}
    assert set(json.loads((saved / "config.json").read_text())) == {"agent", "layout"}


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(DataError, match=f"holds no policy: {name} is missing"):
        Agent.load(saved)


def damage(path: Path, how: str) -> None:
    content = path.read_bytes()
    if how == "empty":
        path.write_bytes(b"")
    elif how == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif how == "noise":
        path.write_bytes(np.random.default_rng(0).bytes(len(content)))
    elif how == "a folder":
        path.unlink()
        path.mkdir()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("how", ["empty", "truncated", "noise", "a folder"])
def test_a_damaged_file_is_told_in_one_line(saved, name, how):
    damage(saved / name, how)
    with pytest.raises(DataError) as caught:
        Agent.load(saved)
    assert str(saved) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["{}", "[]", "null", '{"agent": {}, "layout": {}}', '{"agent": {"task": 3}, "layout": []}'],
)
def test_a_configuration_of_something_else_is_told_in_one_line(saved, text):
    (saved / "config.json").write_text(text)
    for read in (Agent.load, saved_subgoals):
        if read is saved_subgoals and '"agent": {"' in text:
            continue
        with pytest.raises(DataError) as caught:
            read(saved)
        assert "\n" not in str(caught.value)


def test_weights_of_another_network_are_told_in_one_line(saved, tmp_path):
    config = small(AgentConfig("stack"))
    wide = replace(config, sac=replace(config.sac, layers=(24, 24)))
    make_agent(wide, Layout.of(TASKS["stack"])).save(tmp_path / "wide")
    shutil.copy(tmp_path / "wide" / "model.safetensors", saved)
    with pytest.raises(DataError, match=r"no readable policy.*size mismatch") as caught:
        Agent.load(saved)
    assert "\n" not in str(caught.value)


def test_a_save_that_breaks_off_leaves_the_policy_as_it_was(saved, monkeypatch):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}

    def fails(tensors: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pretrain.agent.save_file", fails)
    with pytest.raises(DataError, match="No space"):
        stack_agent().save(saved)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


@pytest.mark.parametrize(("features", "generator"), [("objects", "hybrid"), ("plain", "movers")])
def test_parts_that_need_objects_are_refused_where_there_are_none(features, generator):
    config = replace(small(AgentConfig("Reach-v0")), features=features, generator=generator)
    with pytest.raises(ConfigError, match=r"plain --agent\.generator hybrid"):
        make_agent(config, Layout(5, 3, 3))


def test_a_policy_is_found_by_its_run_its_checkpoint_or_its_folder(saved, tmp_path):
    run = tmp_path / "run"
    step = run / "checkpoints" / "000007"
    shutil.copytree(saved, step / "pretrained_model")
    (run / "checkpoints" / "last").symlink_to("000007")
    for path in (run, step, step / "pretrained_model"):
        assert find_policy(path).resolve() == (step / "pretrained_model").resolve()
    shutil.copytree(saved, run / "best" / "pretrained_model")
    assert find_policy(run) == run / "best" / "pretrained_model"
    with pytest.raises(DataError, match=r"nowhere holds no policy"):
        find_policy(tmp_path / "nowhere")


def test_how_subgoals_are_chosen_is_read_without_the_weights(saved):
    assert saved_subgoals(saved) == AgentConfig("stack").subgoals
