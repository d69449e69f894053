"""Learning in environments that are not ours, from nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import finetune.run
from eisp_data.errors import ConfigError
from eisp_data.sim.gym_worlds import GymWorlds
from finetune.config import EnvConfig, FinetuneConfig, OnlineConfig
from finetune.evaluate import evaluate
from finetune.run import load_for_rollouts
from pretrain import checkpoint
from pretrain.saved import saved_subgoals

SMALL = OnlineConfig(
    rounds=1,
    worlds=2,
    round_steps=10,
    updates=3,
    batch_size=16,
    generator_every=1,
    generator_batch_size=16,
    evaluate_every=1,
    evaluation_episodes=3,
)


@pytest.fixture(autouse=True)
def _few_first_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finetune.run, "_FIRST_EPISODES", 3)


def learn(env_id: str, run: Path, **changes: object) -> dict[str, float]:
    config = FinetuneConfig(run, env=EnvConfig(env_id), online=SMALL, device="cpu", threads=1)
    return finetune.run.finetune(replace(config, **changes))  # type: ignore[arg-type]


def metrics_of(run: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if not k.endswith("_s")} for line in lines]


@pytest.mark.parametrize("env_id", ["FetchPickAndPlace-v4", "line_env:PushedLine-v0"])
def test_an_environment_is_learned_from_nothing(tmp_path, env_id):
    summary = learn(env_id, tmp_path / "run")
    assert 0 <= summary["best_success"] <= 1
    before, after = metrics_of(tmp_path / "run")
    assert (before["updates"], after["updates"]) == (0, 3)
    assert {"train/critic_loss", "train/log_likelihood"} <= set(after)
    # And its policy is one like any other.
    agent = load_for_rollouts(tmp_path / "run", saved_subgoals(tmp_path / "run"), "cpu")
    assert agent.config.task == env_id
    assert evaluate(agent, GymWorlds(env_id, 2), 2, 0).episodes == 2


@pytest.mark.parametrize("env_id", ["line_env:PushedLine-v0", "line_env:ShortPushedLine-v0"])
def test_a_run_in_a_foreign_environment_resumes_as_well(tmp_path, env_id, monkeypatch):
    longer = replace(SMALL, rounds=2)
    learn(env_id, tmp_path / "whole", online=longer)
    save = checkpoint.save

    def save_and_stop(run: Path, at: int, *args: object) -> None:
        save(run, at, *args)  # type: ignore[arg-type]
        if at == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            learn(env_id, tmp_path / "parts", online=longer)
    learn(env_id, tmp_path / "parts", online=longer, resume=True)
    assert metrics_of(tmp_path / "parts") == metrics_of(tmp_path / "whole")


def test_the_first_episodes_are_real_and_end_where_the_environment_ends_them():
    agent, data = finetune.run._from_nothing("line_env:ShortPushedLine-v0", 0)
    assert np.diff(data.episode_start).tolist() == [5, 5, 5]
    for start, stop in zip(data.episode_start, data.episode_start[1:], strict=False):
        moved = np.diff(data.achieved_goal[start:stop, 0])
        np.testing.assert_allclose(moved, 0.05 * data.action[start : stop - 1, 0], atol=1e-6)
    assert len(data.leading)
    assert agent.bank.shape[1] == 2


@pytest.mark.parametrize(
    ("env_id", "said"),
    [
        ("NoSuchEnv-v0", "--env.id NoSuchEnv-v0: "),
        ("CartPole-v1", "CartPole-v1: not a GoalEnv"),
        ("no_such_module:Env-v0", "no_such_module"),
    ],
)
def test_what_is_no_goal_env_is_told_and_leaves_nothing_behind(tmp_path, env_id, said):
    with pytest.raises(ConfigError) as caught:
        learn(env_id, tmp_path / "run")
    assert said in str(caught.value)
    assert not (tmp_path / "run").exists()
