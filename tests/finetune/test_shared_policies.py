"""The policies that come with the project work without training."""

from __future__ import annotations

from pathlib import Path

import pytest

from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS
from finetune.evaluate import evaluate
from pretrain.agent import Agent

POLICIES = Path(__file__).parents[2] / "datasets" / "policies"
EPISODES = 16


@pytest.mark.parametrize("name", TASKS)
def test_a_shared_policy_is_small_and_solves_most_of_its_task(name):
    folder = POLICIES / name
    assert sum(file.stat().st_size for file in folder.iterdir()) < 3_000_000
    agent = Agent.load(folder)
    assert agent.config.task == name
    result = evaluate(agent, Worlds(TASKS[name], EPISODES), EPISODES, seed=77)
    assert result.success_last.mean >= 0.75
