"""Evaluations: intervals against known values, every episode counted once, seeds that repeat."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from learning_samples import linear_agent
from line_env import STEPS

from eisp_data.sim.gym_worlds import GymWorlds
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS
from finetune.evaluate import evaluate, mean_interval, share_interval
from finetune.oracle import oracle_return
from finetune.run import load_for_rollouts
from pretrain.config import SubgoalConfig
from pretrain.saved import saved_subgoals

FINAL_ONLY = SubgoalConfig(source="none")


def line_agent(push: float = 0.0):
    """Return an agent that always pushes as hard, towards larger x."""
    agent = linear_agent(subgoals=FINAL_ONLY)
    agent.sac.actor.body[-1].bias.data[0] = push
    return agent


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (263, 263, 0.9856, 1)],
)
def test_a_share_has_its_wilson_interval(hits, count, low, high):
    found = share_interval(np.arange(count) < hits)
    assert found.mean == hits / count
    assert found.low == pytest.approx(low, abs=1e-4)
    assert found.high == pytest.approx(high, abs=1e-4)


def test_a_mean_has_its_normal_interval():
    found = mean_interval(np.array([1.0, 2.0, 3.0, 4.0]))
    half = 1.959964 * np.sqrt(5 / 3) / 2
    assert [found.low, found.mean, found.high] == pytest.approx([2.5 - half, 2.5, 2.5 + half])
    assert asdict(mean_interval(np.array([-3.0]))) == {"mean": -3.0, "low": -3.0, "high": -3.0}


@pytest.mark.parametrize("batch", [1, 2, 5])
def test_every_episode_counts_once_however_they_are_batched(batch):
    worlds = GymWorlds("line_env:PushedLine-v0", batch)
    result = evaluate(line_agent(), worlds, 5, 100)
    # Seeds 100 to 104: three even ones start at their goal and stay there.
    assert (result.episodes, result.seed) == (5, 100)
    assert result.success_last.mean == result.success_any.mean == 3 / 5
    assert result.return_.mean == pytest.approx(-STEPS * 2 / 5)
    assert sum(result.subgoal_distance.successes) == 3
    assert sum(result.subgoal_distance.failures) == 2
    # The others end one metre from their goal, which is their last subgoal.
    assert result.subgoal_distance.failures[-1] == 2


def test_success_at_some_step_is_not_success_at_the_last():
    result = evaluate(line_agent(push=3.0), GymWorlds("line_env:PushedLine-v0", 2), 4, 100)
    assert result.success_any.mean == 0.5 and result.success_last.mean == 0.0
    assert -STEPS < result.return_.mean <= -STEPS * 0.9


def test_a_foreign_environment_has_no_figures_of_ours():
    result = evaluate(line_agent(), GymWorlds("line_env:PushedLine-v0", 2), 2, 0)
    assert result.relative_return is result.oracle_return is result.paper_return is None
    assert result.success_settled is None
    assert oracle_return("line_env:PushedLine-v0", 2, 0) is None


def test_the_relative_return_is_one_for_the_oracle_and_zero_for_nothing():
    worlds = GymWorlds("line_env:PushedLine-v0", 4)
    result = evaluate(line_agent(), worlds, 4, 100, oracle=-5.0)
    assert result.relative_return.mean == pytest.approx(1.0)
    nothing = evaluate(line_agent(push=9.0), worlds, 1, 101, oracle=-5.0)
    assert nothing.relative_return.mean == 0.0


def test_the_figures_are_plain_json():
    result = evaluate(line_agent(), GymWorlds("line_env:PushedLine-v0", 2), 2, 0)
    plain = json.loads(json.dumps(result.to_plain(), allow_nan=False))
    assert plain["return"]["mean"] == result.return_.mean
    assert plain["success_last"]["low"] == result.success_last.low
    assert set(plain["subgoal_distance"]) == {"edges", "failures", "successes"}


class Seen(Worlds):
    """Worlds that remember what they were reset with."""

    def reset(self, seeds, worlds=None) -> None:
        self.seeds = [*getattr(self, "seeds", []), *seeds]
        super().reset(seeds, worlds)


def test_a_policy_is_evaluated_on_the_seeds_that_are_said_and_the_same_each_time(pretrained):
    subgoals = replace(saved_subgoals(pretrained), candidates=6)
    agent = load_for_rollouts(pretrained, subgoals, "cpu")
    worlds = Seen(TASKS["stack"], 2)
    watched = []
    results = []
    for noise in (1, 2):
        torch.manual_seed(noise)
        state = torch.get_rng_state()
        result = evaluate(agent, worlds, 3, 700, watch=lambda *_: watched.append(1))
        results.append(result.to_plain())
        # Whoever evaluates keeps the random numbers it would have had.
        assert torch.equal(torch.get_rng_state(), state)
    assert worlds.seeds == [700, 701, 702, 703] * 2
    assert results[0] == results[1]
    # Only the first batch is watched.
    assert len(watched) == 2 * worlds.episode_steps


def test_the_oracle_of_a_task_solves_it():
    found = oracle_return("stack", 2, 0)
    assert found is not None and -150 < found < 0
