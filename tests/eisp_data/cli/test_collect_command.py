"""``eisp-collect`` on real worlds and real datasets."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from eisp_data.cli.collect import (
    CONFIG_FILE,
    CollectConfig,
    EnvConfig,
    collect,
    main,
    missing_seeds,
)
from eisp_data.cli.parse import parse
from eisp_data.errors import ConfigError
from eisp_data.policies.registry import SCRIPTS
from eisp_data.seeds import episode_seeds
from eisp_data.storage.episodes import read_index
from eisp_data.storage.lerobot import read_episodes, read_recipe, read_spec
from eisp_data.storage.merge import merge
from eisp_data.storage.rewrite import Source, rewrite
from eisp_data.storage.validate import validate

ARRAYS = (
    "observation", "achieved_goal", "desired_goal", "action", "reward",
    "done", "truncated", "success", "sim_state",
)  # fmt: skip


@pytest.fixture(scope="module")
def stack(tmp_path_factory):
    """Four demonstrations of Stack, by one thread in one world after the other."""
    root = tmp_path_factory.mktemp("stack") / "data"
    config = CollectConfig(root, "stack", episodes=4, seed=1, workers=1, worlds=1)
    collect(config)
    return config


def assert_same(first, second):
    ours, theirs = list(read_episodes(first)), list(read_episodes(second))
    assert len(ours) == len(theirs) > 0
    for one, other in zip(ours, theirs, strict=True):
        assert one.seed == other.seed
        for name in ARRAYS:
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_the_same_seed_gives_the_same_bytes_with_any_workers_and_worlds(stack, tmp_path):
    collect(replace(stack, output_dir=tmp_path / "data", workers=2, worlds=3))
    assert_same(stack.output_dir, tmp_path / "data")


def test_a_resumed_dataset_is_the_one_that_was_never_interrupted(stack, tmp_path, capsys):
    collect(replace(stack, output_dir=tmp_path / "data", episodes=1))
    collect(replace(stack, output_dir=tmp_path / "data", resume=True))
    assert_same(stack.output_dir, tmp_path / "data")
    assert not configured_again(tmp_path / "data", tmp_path / "other").resume
    assert "4 episodes" in capsys.readouterr().out


def test_resume_goes_on_with_the_settings_that_were_saved(stack, tmp_path, monkeypatch):
    root = tmp_path / "data"
    collect(replace(stack, output_dir=root, episodes=1))
    monkeypatch.setattr(sys, "argv", ["eisp-collect", "--output-dir", str(root), "--resume"])
    main()
    assert configured_again(root, root) == replace(stack, output_dir=root, episodes=1)
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--episodes", "2"])
    main()
    assert len(read_index(root)) == 2
    assert configured_again(root, root) == replace(stack, output_dir=root, episodes=2)


def test_a_task_without_a_script_says_so(tmp_path, monkeypatch):
    monkeypatch.delitem(SCRIPTS, "stack")
    with pytest.raises(ConfigError, match="stack has no script; give --policy random"):
        collect(CollectConfig(tmp_path / "data", "stack"))


def test_resume_collects_what_a_repair_had_lost_and_no_episode_twice(stack, tmp_path):
    less, root = tmp_path / "less", tmp_path / "data"
    kept = Source(read_index(stack.output_dir), [0, 3])
    rewrite([kept], less, read_spec(stack.output_dir), read_recipe(stack.output_dir))
    merge([less], root)
    collect(replace(stack, output_dir=root, resume=True))
    assert [episode.seed - 2_000_000 for episode in read_episodes(root)] == [0, 3, 1, 2]
    by_seed = {episode.seed: episode for episode in read_episodes(root)}
    for one in read_episodes(stack.output_dir):
        for name in ARRAYS:
            assert np.array_equal(getattr(one, name), getattr(by_seed[one.seed], name)), name
    assert [path.name for path in root.glob("meta/episodes/*/*")] == ["file-000.parquet"]
    assert all(check.passed for check in validate(root))


@pytest.mark.parametrize(
    ("present", "episodes", "lacking"),
    [
        ([], 3, [0, 1, 2]),
        ([0, 1], 4, [2, 3]),
        ([0, 1, 4, 5], 6, [2, 3]),
        ([0, 1, 4, 5], 7, [2, 3, 6]),
        ([0, 1, 4, 5], 3, []),
        ([0, 1, 0, 1], 5, [2]),
    ],
)
def test_the_seeds_to_come_are_the_first_that_are_not_there(present, episodes, lacking):
    first = episode_seeds(7, 0, 1).start
    assert missing_seeds(7, [first + n for n in present], episodes) == [first + n for n in lacking]


def configured_again(dataset, to):
    words = ["--config", str(dataset / CONFIG_FILE), "--output-dir", str(to)]
    return parse(CollectConfig, words, config_file=True)


def test_the_configuration_is_in_the_dataset_and_makes_it_anew_elsewhere(stack, tmp_path):
    again = configured_again(stack.output_dir, tmp_path / "data")
    assert again == replace(stack, output_dir=tmp_path / "data")


def test_what_is_saved_says_nothing_of_this_machine(stack):
    """A push would publish it."""
    saved = (stack.output_dir / CONFIG_FILE).read_text()
    assert "output_dir" not in saved and str(stack.output_dir.parent) not in saved
    with pytest.raises(ConfigError, match="missing --output-dir"):
        parse(CollectConfig, ["--config", str(stack.output_dir / CONFIG_FILE)], config_file=True)


def test_the_recipe_says_who_acted_and_how_noisily(stack):
    recipe = read_recipe(stack.output_dir)
    assert (recipe["policy"], recipe["seed"]) == ("scripted", 1)
    assert recipe["noise"]["action_std"] > 0


def test_the_oracle_succeeds(tmp_path):
    collect(CollectConfig(tmp_path / "data", "stack", policy="oracle", episodes=2))
    assert all(episode.success[-1] for episode in read_episodes(tmp_path / "data"))


def test_any_goal_env_is_explored_at_random(tmp_path):
    collect(CollectConfig(tmp_path / "data", env=EnvConfig("FetchPickAndPlace-v4"), episodes=2))
    spec = read_spec(tmp_path / "data")
    assert (spec.task, spec.observation_dim, spec.sim_state_dim) == ("FetchPickAndPlace-v4", 25, 0)
    first, second = read_episodes(tmp_path / "data")
    assert len(first) == len(second) == 50
    assert first.truncated[-1]
    assert not np.array_equal(first.action, second.action)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "give one of --task and --env.id"),
        ({"task": "stack", "env": EnvConfig("X-v0")}, "give one of --task and --env.id"),
        ({"task": "stak"}, "unknown task 'stak'; choose one of stack, push4"),
        ({"env": EnvConfig("X-v0"), "policy": "oracle"}, "--policy oracle needs --task"),
        ({"env": EnvConfig("CartPole-v1")}, "not a GoalEnv"),
        ({"env": EnvConfig("Nope-v0")}, "Nope"),
        ({"task": "stack", "episodes": 0}, "--episodes must be 1 to"),
        ({"task": "stack", "seed": -1}, "--seed must be 0 to"),
        ({"task": "stack", "workers": 0}, "--workers must be at least 1"),
        ({"task": "stack", "resume": True}, "holds no dataset"),
    ],
)
def test_a_mistake_is_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ConfigError) as caught:
        collect(CollectConfig(tmp_path / "data", **changes))
    assert message in str(caught.value)
    assert not (tmp_path / "data").exists()


def test_a_dataset_is_not_written_over(stack):
    with pytest.raises(ConfigError, match="add --resume"):
        collect(stack)


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write to"):
        collect(CollectConfig(tmp_path / "file" / "data", "stack", episodes=1))


@pytest.mark.parametrize("words", [["--task", "stak"], ["--tsk", "stack"], []])
def test_the_process_says_it_in_one_line_and_exits_with_2(words, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "eisp_data.cli.collect", "--output-dir", tmp_path / "data", *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "data").exists()
