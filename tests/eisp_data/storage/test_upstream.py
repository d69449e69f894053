"""LeRobot's own code on our datasets: it opens, edits and trains on them, and loses nothing."""

from __future__ import annotations

import json
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from storage_samples import assert_same, random_episode, spec_of

from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import DatasetWriter, read_episodes, read_recipe, read_spec


@pytest.fixture(autouse=True)
def _offline(monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path / "hf"))


@pytest.fixture
def edit(monkeypatch):
    """Return a function that runs ``lerobot-edit-dataset`` with the given flags."""
    from lerobot.scripts.lerobot_edit_dataset import main

    def run(**flags):
        words = [f"--{name}={value}" for name, value in flags.items()]
        monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *words])
        main()

    return run


def open_upstream(root):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(f"test/{root.name}", root=root)


def check(root, episodes, images=True):
    """Compare a dataset with the episodes it should hold, read by us and by LeRobot."""
    for ours, theirs in zip(episodes, read_episodes(root, images=images), strict=True):
        assert_same(ours, theirs)
    dataset = open_upstream(root)
    assert dataset.num_episodes == len(episodes)
    assert len(dataset) == sum(map(len, episodes))
    for number, episode in enumerate(episodes):
        first = dataset.meta.episodes[number]["dataset_from_index"]
        for step in (0, len(episode) - 1):
            item = dataset[first + step]
            assert np.array_equal(item["action"], episode.action[step])
            assert np.array_equal(item["observation.state"], episode.observation[step, :10])
            assert bool(item["next.truncated"]) == episode.truncated[step]
            for camera, frames in episode.images.items():
                image = item[f"observation.images.{camera}"].numpy().transpose(1, 2, 0) * 255
                assert np.abs(image - frames[step]).mean() < 4
    assert load_arrays(root).num_steps == len(dataset)


def test_it_opens_and_info_counts_what_was_written(make_dataset, edit, capsys):
    root, episodes = make_dataset(cameras=True)
    check(root, episodes)
    edit(**{"repo_id": "test/dataset", "root": root, "operation.type": "info"})
    said = capsys.readouterr().out
    assert "Total episode: 5" in said and "Actual Count): 40(40)" in said


def test_it_opens_what_an_earlier_version_began_and_this_one_goes_on_with(make_dataset):
    """Then ``meta/episodes`` had a column more; while a batch is new, its files differ."""
    root, episodes = make_dataset()
    first = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(first)
    after = table.column_names.index("operator") + 1
    pq.write_table(table.add_column(after, "noise", pa.array([np.nan] * 5)), first)
    more = [random_episode(spec_of(), 7, 50)]
    with DatasetWriter(root, spec_of(), {"policy": "script", "seed": 0}, resume=True) as writer:
        writer.write(more)
        check(root, [*episodes, *more])
    assert not first.with_name("file-001.parquet").exists()
    check(root, [*episodes, *more])


def test_episodes_are_filtered_by_what_we_say_of_them(make_dataset):
    root, episodes = make_dataset()
    meta = open_upstream(root).meta
    kept = meta.filter_episodes(lambda row: row["success"] and row["policy"] == "script")
    assert kept == [n for n, episode in enumerate(episodes) if episode.success[-1]]


def test_statistics_are_what_upstream_computes(make_dataset, tmp_path):
    from lerobot.datasets import recompute_stats

    root, _ = make_dataset(count=30)
    ours = json.loads((root / "meta/stats.json").read_text())
    recompute_stats(open_upstream(root))
    theirs = json.loads((root / "meta/stats.json").read_text())
    assert set(theirs) <= set(ours)
    assert {"action", "observation.state", "next.reward"} <= set(theirs)
    for name, column in theirs.items():
        assert set(ours[name]) == set(column)
        spread = np.max(np.subtract(column["max"], column["min"]))
        for stat, values in column.items():
            # Its quantiles come from a histogram of each episode, ours from the sorted values.
            tolerance = 1e-5 if stat[1:].isdigit() is False else 0.15 * spread
            assert np.shape(ours[name][stat]) == np.shape(values), (name, stat)
            assert np.allclose(ours[name][stat], values, atol=tolerance + 1e-6), (name, stat)


def test_deleting_episodes_loses_nothing_of_the_others(make_dataset, edit, tmp_path):
    root, episodes = make_dataset(cameras=True)
    edit(
        **{
            "repo_id": "test/dataset",
            "root": root,
            "new_repo_id": "test/deleted",
            "new_root": tmp_path / "deleted",
            "operation.type": "delete_episodes",
            "operation.episode_indices": "[1,3]",
        }
    )
    check(tmp_path / "deleted", [episodes[0], episodes[2], episodes[4]])
    assert read_spec(tmp_path / "deleted") == spec_of(cameras=True)
    assert read_recipe(tmp_path / "deleted") == {"policy": "script", "seed": 0}


def test_splitting_and_merging_again_gives_the_same_episodes(make_dataset, edit, tmp_path):
    root, episodes = make_dataset(cameras=True)
    edit(
        **{
            "repo_id": "test/dataset",
            "root": root,
            "new_root": tmp_path / "split",
            "operation.type": "split",
            "operation.splits": json.dumps({"even": [0, 2, 4], "odd": [1, 3]}),
        }
    )
    check(tmp_path / "split/even", episodes[::2])
    check(tmp_path / "split/odd", episodes[1::2])
    other, more = make_dataset("other", count=4, seed=100, cameras=True)
    parts = [tmp_path / "split/even", tmp_path / "split/odd", other]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path / "hf2"))
        edit(
            **{
                "new_repo_id": "test/all",
                "new_root": tmp_path / "all",
                "operation.type": "merge",
                "operation.repo_ids": json.dumps([f"test/{part.name}" for part in parts]),
                "operation.roots": json.dumps([str(part) for part in parts]),
            }
        )
    check(tmp_path / "all", [*episodes[::2], *episodes[1::2], *more])
    recipes = [{"policy": "script", "seed": 0}, {"policy": "script", "seed": 100}]
    assert read_recipe(tmp_path / "all") == {"merged": recipes}
    edit(
        **{
            "repo_id": "test/all",
            "root": tmp_path / "all",
            "new_repo_id": "test/fewer",
            "new_root": tmp_path / "fewer",
            "operation.type": "delete_episodes",
            "operation.episode_indices": "[0,6]",
        }
    )
    check(tmp_path / "fewer", [*episodes[2::2], *episodes[1::2], *more[:1], *more[2:]])


def test_stock_training_of_act_runs_on_it(make_dataset, monkeypatch, tmp_path):
    from lerobot.scripts.lerobot_train import main

    root, _ = make_dataset(count=4, cameras=True)
    flags = {
        "dataset.repo_id": "test/dataset",
        "dataset.root": root,
        "policy.type": "act",
        "policy.device": "cpu",
        "policy.push_to_hub": "false",
        "policy.dim_model": 32,
        "policy.n_heads": 2,
        "policy.dim_feedforward": 32,
        "policy.n_encoder_layers": 1,
        "policy.n_vae_encoder_layers": 1,
        "policy.chunk_size": 4,
        "policy.n_action_steps": 4,
        "policy.pretrained_backbone_weights": "null",
        "steps": 2,
        "batch_size": 2,
        "num_workers": 0,
        "wandb.enable": "false",
        "output_dir": tmp_path / "run",
    }
    words = [f"--{name}={value}" for name, value in flags.items()]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *words])
    main()
    assert (tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors").exists()
