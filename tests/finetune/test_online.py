"""Online fine-tuning of a small policy in Stack, interrupted and not."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from learning_samples import linear_agent, make_agent, small
from safetensors.torch import load_file

import finetune.train as finetune_train
from eisp_data.cli.collect import CollectConfig, collect
from eisp_data.errors import ConfigError, DataError
from eisp_data.seeds import SELECTION_SEED
from eisp_data.sim.gym_worlds import GymWorlds
from finetune.config import DataConfig, EnvConfig, FinetuneConfig, OnlineConfig, PolicyConfig
from finetune.evaluate import Evaluation
from finetune.rollout import SubgoalPolicy
from finetune.run import finetune, make_worlds
from finetune.train import Finetuner, Rollouts, _with_pursued, summarise
from pretrain import checkpoint
from pretrain.config import AgentConfig, GoalMix, SubgoalConfig
from pretrain.layout import Layout
from pretrain.learner import Learner
from pretrain.replay import Trajectories
from pretrain.sac import Batch
from pretrain.saved import saved_subgoals

SMALL = OnlineConfig(
    rounds=2,
    worlds=2,
    round_steps=50,
    updates=4,
    batch_size=16,
    generator_every=2,
    generator_batch_size=16,
    evaluate_every=1,
    evaluation_episodes=1,
)


class Killed(BaseException):
    """The process ends here."""


def tiny_finetuning(pretrained: Path, output_dir: Path, **online: object) -> FinetuneConfig:
    return FinetuneConfig(
        output_dir,
        PolicyConfig(pretrained),
        subgoals=saved_subgoals(pretrained),
        online=replace(SMALL, **online),  # type: ignore[arg-type]
        device="cpu",
        threads=1,
    )


@pytest.fixture(scope="module")
def finished(pretrained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing interrupted; not to be changed."""
    run = tmp_path_factory.mktemp("finetuned") / "run"
    finetune(tiny_finetuning(pretrained, run))
    return run


def metrics_of(run: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if not k.endswith("_s")} for line in lines]


def assert_same_run(ours: Path, theirs: Path) -> None:
    assert metrics_of(ours) == metrics_of(theirs)
    assert (ours / "summary.json").read_text() == (theirs / "summary.json").read_text()
    for policy in ("checkpoints/last/pretrained_model", "best/pretrained_model"):
        a, b = (load_file(run / policy / "model.safetensors") for run in (ours, theirs))
        assert all(torch.equal(a[name], b[name]) for name in a | b)


def test_a_run_keeps_its_history_and_logs_each_evaluation(finished, pretrained):
    lines = metrics_of(finished)
    before = [line for line in lines if line["stage"] == "pretrain"]
    online = [line for line in lines if line["stage"] == "finetune"]
    assert before == metrics_of(pretrained) and lines == before + online
    assert [line["env_steps"] for line in online] == [0, 100, 200]
    assert [line["updates"] for line in online] == [0, 4, 8]
    assert all(0 <= line["eval/success_last"] <= line["eval/success_any"] for line in online)
    assert {"train/critic_loss", "train/log_likelihood"} <= set(online[1])
    assert (finished / "finetune.yaml").is_file() and (finished / "summary.json").is_file()


def test_learning_moves_actor_critic_and_generator(finished, pretrained):
    before, after = (
        load_file(run / "checkpoints/last/pretrained_model/model.safetensors")
        for run in (pretrained, finished)
    )
    for part in ("sac.actor.body", "sac.critic.body", "sac.target.body", "proposer"):
        names = [name for name in before if name.startswith(part)]
        assert names and any(not torch.equal(before[name], after[name]) for name in names)
    assert torch.equal(before["bank"], after["bank"])


@pytest.mark.parametrize("checkpointed", [True, False])
def test_a_run_that_is_interrupted_and_resumed_ends_like_one_that_is_not(
    finished, pretrained, tmp_path, monkeypatch, checkpointed
):
    config = tiny_finetuning(pretrained, tmp_path / "run")
    save = checkpoint.save

    def save_and_die(run: Path, at: int, *args: object) -> None:
        if at == 0 or checkpointed:
            save(run, at, *args)  # type: ignore[arg-type]
        if at == 1:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", save_and_die)
        with pytest.raises(Killed):
            finetune(config)
    torch.manual_seed(99)
    finetune(replace(config, resume=True))
    assert_same_run(tmp_path / "run", finished)


def test_a_process_that_is_really_killed_goes_on_as_if_it_had_not_been(
    finished, pretrained, tmp_path
):
    run = tmp_path / "run"
    flags = {f"--online.{k.replace('_', '-')}": v for k, v in vars(SMALL).items()}
    words = ["--policy.path", pretrained, "--output-dir", run, "--device", "cpu", "--threads", "1"]
    words += [part for pair in flags.items() for part in pair]
    program = "from finetune.cli.finetune import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    wait_for(lambda: (run / "checkpoints/000001").exists() or process.poll() is not None)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not (run / "summary.json").exists()
    finetune(replace(tiny_finetuning(pretrained, run), resume=True))
    assert_same_run(run, finished)


def wait_for(happened: Callable[[], bool]) -> None:
    while not happened():
        time.sleep(0.005)


def test_a_run_that_is_killed_before_its_first_checkpoint_starts_over(
    finished, pretrained, tmp_path, monkeypatch
):
    config = tiny_finetuning(pretrained, tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "save", lambda *_: (_ for _ in ()).throw(Killed))
        with pytest.raises(Killed):
            finetune(config)
    finetune(replace(config, resume=True))
    assert_same_run(tmp_path / "run", finished)


@pytest.mark.parametrize("source", ["random", "none"])
def test_the_same_commands_show_what_the_subgoals_are_worth(pretrained, tmp_path, source):
    config = tiny_finetuning(pretrained, tmp_path / "run", rounds=1)
    summary = finetune(replace(config, subgoals=SubgoalConfig(source=source)))
    assert set(summary) == {"offline_success", "dip", "recovery_steps", "best_success"}


def test_a_generator_may_be_left_as_it_is(pretrained, tmp_path):
    finetune(tiny_finetuning(pretrained, tmp_path / "run", rounds=1, generator_every=0))
    before, after = (
        load_file(run / "checkpoints/last/pretrained_model/model.safetensors")
        for run in (pretrained, tmp_path / "run")
    )
    names = [name for name in before if name.startswith("proposer")]
    assert all(torch.equal(before[name], after[name]) for name in names)


def test_the_policy_that_is_best_on_all_episodes_is_kept(pretrained, tmp_path, monkeypatch):
    # Each that looks best is tried again: the last one was lucky.
    said, asked, real = iter([0.2, 0.2, 0.8, 0.9, 1.0, 0.8]), [], finetune_train.evaluate

    def evaluate(*args: object, **options: object) -> Evaluation:
        asked.append((args[3] - SELECTION_SEED, args[2]))  # type: ignore[operator]
        result = real(*args, **options)  # type: ignore[arg-type]
        return replace(result, success_last=replace(result.success_last, mean=next(said)))

    monkeypatch.setattr(finetune_train, "evaluate", evaluate)
    summary = finetune(tiny_finetuning(pretrained, tmp_path))
    assert asked == [(0, 1), (1, 3)] * 3
    assert summary["offline_success"] == 0.2
    assert summary["best_success"] == pytest.approx(0.875)
    best, second, last = (
        load_file(tmp_path / name / "pretrained_model/model.safetensors")
        for name in ("best", "checkpoints/000001", "checkpoints/last")
    )
    assert all(torch.equal(best[name], second[name]) for name in best)
    assert any(not torch.equal(best[name], last[name]) for name in best)


def test_a_round_is_as_its_settings_say(pretrained, tmp_path, monkeypatch):
    rates, noises, drawn = [], [], []
    collect_round, transitions = Rollouts.collect, Trajectories.transitions

    def collect(rollouts: Rollouts, steps: int, noise: float) -> tuple[np.ndarray, ...]:
        noises.append(noise)
        return collect_round(rollouts, steps, noise)

    def draw(data: Trajectories, count: int, mix: GoalMix, rng: np.random.Generator) -> Batch:
        drawn.append((data._purposeful, count, mix.pursued))
        return transitions(data, count, mix, rng)

    monkeypatch.setattr(Learner, "set_lr", lambda _, *both: rates.append(both))
    monkeypatch.setattr(Rollouts, "collect", collect)
    monkeypatch.setattr(Trajectories, "transitions", draw)
    config = tiny_finetuning(
        pretrained, tmp_path, updates=1, noise=0.25, offline_share=0.25, pursued=0.75, lr=1e-3
    )
    finetune(config)
    assert noises == [0.25, 0.25]
    assert drawn == [(False, 12, 0.75), (True, 4, 0.0)] * 2
    np.testing.assert_allclose(rates, [(5e-4, 1.5e-4), (1e-4, 3e-5)])


@pytest.mark.parametrize(("new", "old"), [(30, 10), (0, 5), (5, 0)])
def test_the_generator_learns_from_old_and_new_data_by_their_amounts(new, old):
    def data(rows: int, name: str) -> SimpleNamespace:
        return SimpleNamespace(leading=range(rows), subgoals=lambda *_: name)

    tuner = SimpleNamespace(
        _online=data(new, "new"),
        _offline=data(old, "old"),
        _rng=np.random.default_rng(0),
        _mix=None,
        agent=SimpleNamespace(vision=None),
        config=SMALL,
    )
    said = [Finetuner._hindsight(tuner) for _ in range(2000)]  # type: ignore[arg-type]
    assert said.count("new") / 2000 == pytest.approx(new / (new + old), abs=0.03)


@pytest.mark.parametrize("pursued", [0.0, 0.1, 1.0])
def test_pursued_goals_take_as_much_from_all_others_and_shares_add_up(pursued):
    rest = 1.0 - pursued
    mix = GoalMix(0.5 * rest, 0.25 * rest, 0.25 * rest, pursued)
    online = _with_pursued(mix, 0.4)
    shares = np.array([online.waypoint, online.future, online.displaced, online.pursued])
    expected = [0, 0, 0, 1] if pursued == 1 else [0.3, 0.15, 0.15, 0.4]
    np.testing.assert_allclose(shares, expected, atol=1e-12)


def test_what_cannot_be_resumed_is_told_and_changes_nothing(finished, tmp_path, pretrained):
    shutil.copytree(finished, tmp_path / "run", symlinks=True)
    config = replace(tiny_finetuning(pretrained, tmp_path / "run"), resume=True)
    before = (tmp_path / "run/finetune.yaml").read_text()
    with pytest.raises(DataError, match=r"--online\.worlds 3: the run to resume has 2"):
        finetune(replace(config, online=replace(SMALL, worlds=3)))
    assert (tmp_path / "run/finetune.yaml").read_text() == before
    finetune(config)
    assert_same_run(tmp_path / "run", finished)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dataset": DataConfig(Path("other"))}, r"the run learns from .*, not from other; if"),
        ({"policy": PolicyConfig(Path("other"))}, r"began with --policy\.path .*, not .*other; if"),
        ({"env": EnvConfig("FetchReach-v4")}, r"began with --env\.id None, not FetchReach-v4; if"),
    ],
)
def test_a_run_goes_on_with_what_it_began_with(finished, tmp_path, pretrained, changes, said):
    shutil.copytree(finished, tmp_path / "run", symlinks=True)
    config = replace(tiny_finetuning(pretrained, tmp_path / "run"), resume=True, **changes)
    with pytest.raises(ConfigError, match=said):
        finetune(config)


def test_a_policy_of_a_recording_with_arrays_of_its_own_is_told_from_the_tasks():
    agent = make_agent(
        small(AgentConfig("stack", features="plain", generator="hybrid")), Layout(23, 9, 4)
    )
    with pytest.raises(ConfigError, match=r"of \(23, 9, 4\) numbers; .* have \(55, 9, 4\)"):
        make_worlds(agent, 1)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"online": replace(SMALL, lr=float("nan"))}, "--online.lr must be above 0; got nan"),
        ({"policy": PolicyConfig()}, "give --policy.path, a pretrained policy, or --env.id"),
        ({"policy": PolicyConfig(Path("nowhere"))}, "nowhere holds no policy"),
        ({"env": EnvConfig("FetchReach-v4")}, "is a policy of 'stack', not 'FetchReach-v4'"),
        ({"dataset": DataConfig(Path("nowhere"))}, "nowhere: not a LeRobot dataset"),
        ({"online": replace(SMALL, round_steps=7)}, "--online.round-steps 7 must divide the 300"),
        ({"online": replace(SMALL, worlds=0)}, "--online.worlds must be at least 1; got 0"),
        ({"online": replace(SMALL, evaluate_every=0)}, "--online.evaluate-every must be at least"),
        ({"online": replace(SMALL, replay_size=50)}, "--online.replay-size must be at least 51"),
        ({"online": replace(SMALL, offline_share=1.5)}, "--online.offline-share must be 0 to 1"),
        ({"subgoals": SubgoalConfig(every_steps=0)}, "--subgoals.every-steps must be at least 1"),
        ({"seed": -1}, "--seed must be 0 to 4294967295; got -1"),
        ({"resume": True}, "holds no run, finetune.yaml is missing"),
    ],
)
def test_what_cannot_be_run_is_told_and_leaves_nothing_behind(pretrained, tmp_path, changes, said):
    config = replace(tiny_finetuning(pretrained, tmp_path / "run"), **changes)
    with pytest.raises((ConfigError, DataError)) as caught:
        finetune(config)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_dataset_of_another_task_is_refused(pretrained, tmp_path):
    root = tmp_path / "push4"
    collect(CollectConfig(root, task="push4", policy="random", episodes=1, workers=1))
    config = tiny_finetuning(pretrained, tmp_path / "run")
    with pytest.raises(DataError, match="is a dataset of 'push4', not of 'stack'"):
        finetune(replace(config, dataset=DataConfig(root)))
    assert not (tmp_path / "run").exists()


def rollouts(env_id: str, count: int = 3, source: str = "none") -> Rollouts:
    worlds = GymWorlds(f"line_env:{env_id}", count)
    agent = linear_agent(subgoals=SubgoalConfig(source=source, candidates=1))
    policy = SubgoalPolicy(agent, count)
    started = Rollouts(worlds, policy, next_seed=101, solved=np.zeros(count, bool))
    torch.manual_seed(0)
    started.start(np.arange(count))
    return started


def test_collected_rows_are_what_happened():
    started = rollouts("PushedLine-v0")
    goals = np.repeat(started.worlds.desired_goal, 6, axis=0)
    observation, achieved, action, pursued, starts = started.collect(5, 1.0)
    np.testing.assert_array_equal(pursued, goals)
    assert starts.tolist() == [0, 6, 12, 18]
    np.testing.assert_array_equal(observation, achieved)
    for first, stop in zip(starts, starts[1:], strict=False):
        moved = np.diff(achieved[first:stop], axis=0)
        np.testing.assert_allclose(moved[:, 0], 0.05 * action[first : stop - 1, 0], atol=1e-6)
        assert (moved[:, 1] == 0).all() and (action[stop - 1] == 0).all()
    assert len(np.unique(achieved[:, 0])) == len(achieved)


def test_a_world_that_ends_early_leaves_no_rows_after_its_end():
    started = rollouts("ShortPushedLine-v0")
    _, achieved, action, _, starts = started.collect(10, 1.0)
    assert np.diff(starts).tolist() == [5, 5, 5]
    for first, stop in zip(starts, starts[1:], strict=False):
        moved = np.diff(achieved[first:stop, 0])
        np.testing.assert_allclose(moved, 0.05 * action[first : stop - 1, 0], atol=1e-6)
    assert started.worlds.steps.tolist() == [0, 0, 0]


def test_worlds_start_anew_when_they_are_over_or_have_kept_a_success_for_a_round():
    started = rollouts("PushedLine-v0")
    # The noise stays within 5 cm of where each began: 102 begins at its goal, 101 and 103 do not.
    started.policy._agent.sac.actor.body[-1].bias.data[1] = -5.0
    started.collect(2, 1.0)
    assert started.worlds.steps.tolist() == [2, 2, 2] and started.next_seed == 104
    started.collect(2, 1.0)
    assert started.worlds.steps.tolist() == [4, 0, 4] and started.next_seed == 105
    assert started.policy.age[1] == started.policy._config.every_steps
    # The world that started anew had seed 104, an even one, and has to keep its success as well.
    started.collect(6, 1.0)
    assert started.worlds.steps.tolist() == [0, 6, 0] and started.next_seed == 107


def test_rollouts_go_on_from_their_state():
    first, again = (
        rollouts("PushedLine-v0", source="random"),
        rollouts("PushedLine-v0", source="random"),
    )
    first.collect(3, 1.0)
    state = {name: value.copy() for name, value in first.state().items()}
    torch.manual_seed(7)
    expected = first.collect(4, 1.0)
    again.restore(state)
    torch.manual_seed(7)
    for a, b in zip(again.collect(4, 1.0), expected, strict=True):
        np.testing.assert_array_equal(a, b)
    assert again.next_seed == first.next_seed


def curve(*success: float) -> list[dict[str, float]]:
    return [{"env_steps": 100 * i, "success_last": value} for i, value in enumerate(success)]


@pytest.mark.parametrize(
    ("success", "dip", "recovery_steps"),
    [
        ((0.5, 0.6, 0.7), 0.0, 0),
        ((0.5, 0.3, 0.5, 0.9), 0.2, 200),
        # From the last evaluation that was as good, over both dips, to the first after the lowest.
        ((0.5, 0.6, 0.4, 0.5, 0.1, 0.3, 0.8), 0.4, 500),
        ((0.5, 0.2, 0.4), 0.3, float("nan")),
        ((0.0, 0.0, 0.3), 0.0, 0),
        ((0.7,), 0.0, 0),
    ],
)
def test_the_summary_tells_the_dip_and_the_steps_to_recover(success, dip, recovery_steps):
    summary = summarise(curve(*success))
    assert summary["offline_success"] == success[0]
    assert summary["dip"] == pytest.approx(dip)
    assert summary["recovery_steps"] == pytest.approx(recovery_steps, nan_ok=True)
