"""The oracle's subgoals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from learning_samples import linear_agent, make_agent, small

from eisp_data.errors import ConfigError
from eisp_data.sim.gym_worlds import GymWorlds
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS
from finetune.oracle import OracleSubgoals, subgoal_policy
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent
from pretrain.config import AgentConfig, SubgoalConfig
from pretrain.layout import Layout

WORLDS = 3


def oracle_led(task: str) -> Agent:
    config = AgentConfig(task, subgoals=SubgoalConfig(source="oracle"))
    return make_agent(small(config), Layout.of(TASKS[task]))


@pytest.mark.parametrize("task", sorted(TASKS))
def test_an_oracles_subgoal_is_one_move_ahead_and_leaves_the_world_as_it_is(task):
    worlds = Worlds(TASKS[task], WORLDS)
    worlds.reset(range(WORLDS))
    before = worlds.state.copy()
    policy = subgoal_policy(oracle_led(task), worlds)
    assert isinstance(policy, OracleSubgoals)
    policy.act(worlds.observation, worlds.achieved_goal, worlds.desired_goal)
    np.testing.assert_array_equal(worlds.state, before)
    way = (policy.subgoal - worlds.achieved_goal).reshape(WORLDS, -1, 3)
    assert (np.linalg.norm(way, axis=2).max(axis=1) > 0.02).all()


def test_stacks_first_subgoal_brings_one_block_to_its_goal_or_out_of_the_way():
    worlds = Worlds(TASKS["stack"], WORLDS)
    worlds.reset(range(WORLDS))
    policy = OracleSubgoals(oracle_led("stack"), worlds)
    policy.act(worlds.observation, worlds.achieved_goal, worlds.desired_goal)
    moved = np.linalg.norm((policy.subgoal - worlds.achieved_goal).reshape(WORLDS, 3, 3), axis=2)
    assert ((moved > 0.02).sum(axis=1) == 1).all()


def test_an_environment_without_a_script_has_no_oracle():
    agent = linear_agent(subgoals=replace(SubgoalConfig(), source="oracle"))
    with pytest.raises(ConfigError, match=r"has no scripted policy, .*; choose generator"):
        subgoal_policy(agent, GymWorlds("line_env:PushedLine-v0", 1))


def test_other_sources_need_no_worlds():
    agent = linear_agent()
    policy = subgoal_policy(agent, GymWorlds("line_env:PushedLine-v0", 1))
    assert type(policy) is SubgoalPolicy
