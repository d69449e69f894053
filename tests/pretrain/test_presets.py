"""Presets, the paper's against its Table I, and settings that cannot be used."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning_samples import tiny_pretraining

from eisp_data.config import from_plain, to_plain
from eisp_data.errors import ConfigError
from eisp_data.tasks.base import SUCCESS_DISTANCE_M
from eisp_data.tasks.registry import TASKS
from pretrain.checks import check_pretrain
from pretrain.config import (
    GoalMix,
    HybridConfig,
    MoversConfig,
    PretrainConfig,
    SacConfig,
    SubgoalConfig,
)
from pretrain.layout import Layout
from pretrain.presets import preset
from pretrain.replay import Trajectories

HERE = Path("data"), Path("runs")


@pytest.mark.parametrize("name", ["cpu", "paper"])
@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_preset_that_can_be_used_and_written_down(name, task):
    config = preset(name, task, *HERE)
    check_pretrain(config)
    assert config.agent.task == task
    assert from_plain(PretrainConfig, to_plain(config)) == config


@pytest.mark.parametrize("task", TASKS)
def test_the_papers_preset_is_its_table_1(task):
    config, table = preset("paper", task, *HERE), TASKS[task].paper
    agent = config.agent
    assert (agent.features, agent.generator) == ("plain", "hybrid")
    assert agent.waypoints == table.waypoints
    assert agent.sac.layers == table.policy_layers and agent.sac.lr == table.sac_lr
    assert (agent.sac.alpha, agent.sac.gamma) == (table.alpha, table.gamma)
    assert agent.hybrid.layers == table.generator_layers and agent.hybrid.beta == table.beta
    assert config.generator_lr == table.generator_lr
    assert config.batch_size == config.generator_batch_size == table.batch_size
    assert agent.subgoals.every_steps == table.subgoal_steps
    assert agent.subgoals.selector == "value"
    assert agent.subgoals.reached_m == agent.subgoals.final_m == SUCCESS_DISTANCE_M
    # Plain SAC: what is ours is off.
    assert not agent.sac.layer_norm and not agent.sac.clip_targets and agent.sac.cloning == 0
    assert agent.mix.tolerance_m == SUCCESS_DISTANCE_M and agent.mix.displaced == 0
    assert agent.mix.errors == 0 and config.final_lr_share == config.generator_final_lr_share == 1


def test_the_papers_generator_learns_to_get_to_the_end_of_the_trajectory():
    mix = preset("paper", "stack", *HERE).agent.mix
    data = Trajectories(Layout(9, 9, 4), 10**9, 4, purposeful=True)
    rng = np.random.default_rng(0)
    path = rng.normal(size=(13, 9)).astype(np.float32)
    data.extend(path, path, np.zeros((13, 4), np.float32), path, np.array([0, 13]))
    observation, goal, subgoal = (part.numpy() for part in data.subgoals(64, mix, rng))
    assert (goal == path[12]).all()
    for seen, following in zip(observation, subgoal, strict=True):
        [row] = np.flatnonzero((path == seen).all(1))
        np.testing.assert_array_equal(following, path[3 * (row // 3 + 1)])


def test_another_environment_gets_what_needs_no_objects_and_no_rest():
    config = preset("cpu", "FetchReach-v4", *HERE)
    check_pretrain(config)
    assert (config.agent.features, config.agent.generator) == ("plain", "hybrid")
    assert config.agent.waypoints is not None
    with pytest.raises(ConfigError, match="the paper has no task 'FetchReach-v4'; choose cpu"):
        preset("paper", "FetchReach-v4", *HERE)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"updates": 0}, "--updates must be at least 1; got 0"),
        ({"batch_size": -3}, "--batch-size must be at least 1; got -3"),
        ({"generator_every": 0}, "--generator-every must be at least 1"),
        ({"validate_every": 0}, "--validate-every must be at least 1"),
        ({"threads": 0}, "--threads must be at least 1"),
        ({"seed": -1}, "--seed must be 0 to 4294967295; got -1"),
        ({"validation_share": 1.0}, "--validation-share must be between 0 and 1; got 1.0"),
        ({"validation_share": float("nan")}, "--validation-share"),
        ({"gamma": 1.0}, "--agent.sac.gamma must be at least 0 and below 1; got 1.0"),
        ({"mix": GoalMix(0.5, 0.5, 0.5)}, "--agent.mix: .* add up to 1; got 0.5, 0.5, 0.5"),
        (
            {"mix": GoalMix(0.3333333, 0.3333333, 0.3333333)},
            "--agent.mix: .* add up to 1; got 0.333",
        ),
        (
            {"mix": GoalMix(1.2, -0.2, 0.0)},
            "--agent.mix: .* at least 0 and .*; got 1.2, -0.2",
        ),
        ({"waypoints": 0}, "--agent.waypoints must be at least 1; got 0"),
        ({"candidates": 0}, "--agent.subgoals.candidates must be at least 1; got 0"),
        ({"sac": SacConfig(layers=())}, "--agent.sac.layers must be one or more sizes"),
        ({"sac": SacConfig(lr=-1.0)}, "--agent.sac.lr must be above 0; got -1.0"),
        ({"sac": SacConfig(tau=5.0)}, "--agent.sac.tau must be 0 to 1; got 5.0"),
        ({"sac": SacConfig(tau=0.0)}, "--agent.sac.tau must be above 0; got 0.0"),
        ({"sac": SacConfig(alpha=-1.0)}, "--agent.sac.alpha must be at least 0; got -1.0"),
        ({"movers": MoversConfig(likelihood=-1.0)}, "--agent.movers.likelihood must be at least 0"),
        ({"subgoals": SubgoalConfig(reached_m=float("nan"))}, "--agent.subgoals.reached-m must be"),
        ({"movers": MoversConfig(modes=0)}, "--agent.movers.modes must be at least 1; got 0"),
        ({"hybrid": HybridConfig(layers=(0,))}, "--agent.hybrid.layers must be one or more"),
        ({"mix": GoalMix(complete=2.0)}, "--agent.mix.complete must be 0 to 1; got 2.0"),
        ({"mix": GoalMix(float("nan"))}, "--agent.mix: .* add up to 1; got nan"),
        ({"generator_lr": float("nan")}, "--generator-lr must be above 0; got nan"),
    ],
)
def test_settings_that_cannot_be_used_are_named(changes, said):
    config = tiny_pretraining(*HERE)
    agent = config.agent
    [(name, value)] = changes.items()
    if name == "gamma":
        config = replace(config, agent=replace(agent, sac=replace(agent.sac, gamma=value)))
    elif name == "candidates":
        subgoals = replace(agent.subgoals, candidates=value)
        config = replace(config, agent=replace(agent, subgoals=subgoals))
    elif hasattr(agent, name):
        config = replace(config, agent=replace(agent, **changes))
    else:
        config = replace(config, **changes)
    with pytest.raises(ConfigError, match=said):
        check_pretrain(config)
