"""``eisp-data``: each command does its work, and a mistake is one line and status 2."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest
from storage_samples import assert_same

from eisp_data.cli.data import COMMANDS
from eisp_data.episode import Episode
from eisp_data.errors import ConfigError, DataError
from eisp_data.replay import chosen_episodes
from eisp_data.sim.worlds import Worlds
from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import DatasetSpec, DatasetWriter, read_episodes
from eisp_data.storage.validate import validate
from eisp_data.storage.video import encode_video
from eisp_data.tasks.base import compute_reward, is_success
from eisp_data.tasks.registry import get_task
from eisp_data.view import waypoints

STEPS = 8


@pytest.fixture
def simulated(tmp_path):
    """Return a dataset of two short episodes of random actions in Stack, and the episodes."""
    task = get_task("stack")
    worlds = Worlds(task, 2, threads=1)
    worlds.reset([0, 1])
    states, actions = [worlds.state.copy()], []
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        actions.append(rng.uniform(-1, 1, (2, 4)).astype(np.float32))
        worlds.step(actions[-1])
        states.append(worlds.state.copy())
    episodes = []
    for world in range(2):
        own = np.stack([state[world] for state in states])
        achieved, goal = task.achieved_goal(own), worlds.desired_goal[world].copy()
        episodes.append(
            Episode(
                observation=task.observe(own),
                achieved_goal=achieved,
                desired_goal=goal,
                action=np.stack([action[world] for action in actions]),
                reward=compute_reward(achieved[1:], goal),
                done=np.zeros(STEPS, bool),
                truncated=np.arange(STEPS) == STEPS - 1,
                success=is_success(achieved, goal),
                sim_state=own,
                seed=world,
            )
        )
    spec = DatasetSpec(
        task="stack",
        instruction=task.instruction,
        observation_dim=55,
        goal_dim=9,
        action_dim=4,
        sim_state_dim=episodes[0].sim_state.shape[1],
    )
    with DatasetWriter(tmp_path / "stack", spec, {"policy": "random"}) as writer:
        writer.write(episodes)
    return tmp_path / "stack", episodes


def test_help_names_every_command(eisp_data):
    status, out, _ = eisp_data("--help")
    assert status == 0 and all(f"  {name} " in out for name in COMMANDS)
    for name in COMMANDS:
        status, out, _ = eisp_data(name, "--help")
        assert status == 0 and "usage" in out.lower()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fly"], "unknown command 'fly'; choose one of info, validate"),
        (["info", "/nowhere"], "/nowhere: no such file or folder"),
        (["validate", "/nowhere"], "/nowhere: no such file or folder"),
        (["merge", "/nowhere", "--to", "/tmp/x"], "/nowhere: not a LeRobot dataset"),
        (["repair", "/nowhere"], "/nowhere: no such file or folder"),
        (["info", "x", "--jsn"], "--jsn"),
        (["push", "/nowhere", "--repo-id", "a/b"], "/nowhere: neither a dataset"),
        (["pull", "a/b", "--to", "/tmp"], "/tmp: exists already"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(eisp_data, words, said):
    status, out, err = eisp_data(*words)
    assert status == 2 and said in err
    assert err.startswith("error: ") and err.count("\n") == 1 and out == ""


def test_info_validate_merge_and_repair(eisp_data, make_dataset, tmp_path):
    root, episodes = make_dataset()
    status, out, _ = eisp_data("info", root, "--json")
    assert status == 0 and json.loads(out)["episodes"] == 5
    assert eisp_data("validate", root)[0] == 0
    other, more = make_dataset("other", seed=70)
    assert eisp_data("merge", root, other, "--to", tmp_path / "both")[0] == 0
    for ours, theirs in zip([*episodes, *more], read_episodes(tmp_path / "both"), strict=True):
        assert_same(ours, theirs)
    (tmp_path / "both/meta/info.json").write_text('{"codebase_version": "v3.0"}')
    status, out, _ = eisp_data("validate", tmp_path / "both")
    assert status == 1 and "FAIL episode count" in out
    status, out, _ = eisp_data("repair", tmp_path / "both", "--in-place")
    assert status == 0 and "kept 10 episodes" in out and "lost nothing" in out
    assert eisp_data("validate", tmp_path / "both")[0] == 0


def test_datasets_of_different_specs_are_not_merged(eisp_data, make_dataset, tmp_path):
    root, _ = make_dataset()
    other, _ = make_dataset("other", fps=30)
    status, _, err = eisp_data("merge", root, other, "--to", tmp_path / "both")
    assert status == 2 and "fps is 30" in err and not (tmp_path / "both").exists()


def test_damaged_videos_are_not_merged(eisp_data, make_dataset, tmp_path):
    root, _ = make_dataset(cameras=True)
    other, _ = make_dataset("other", cameras=True)
    video = "videos/observation.images.top/chunk-000/file-001.mp4"
    encode_video(other / video, np.zeros((5, 48, 48, 3), np.uint8), 25)
    status, _, err = eisp_data("merge", root, other, "--to", tmp_path / "both")
    assert status == 2 and f"{other / video}: 5 frames for 27 rows" in err
    assert not (tmp_path / "both").exists()


def test_merging_copies_videos_frame_for_frame(eisp_data, make_dataset, tmp_path):
    root, _ = make_dataset(cameras=True)
    assert eisp_data("merge", root, root, "--to", tmp_path / "twice")[0] == 0
    before = list(read_episodes(root, images=True))
    for ours, theirs in zip(
        [*before, *before], read_episodes(tmp_path / "twice", images=True), strict=True
    ):
        assert np.array_equal(ours.images["top"], theirs.images["top"])
    assert all(check.passed for check in validate(tmp_path / "twice"))


def test_replay_of_a_recorded_episode_deviates_by_nothing(eisp_data, simulated):
    root, _ = simulated
    status, out, _ = eisp_data("replay", root)
    assert status == 0 and out.splitlines()[-1] == "largest deviation 0"


def test_replay_finds_an_action_that_was_not_taken(eisp_data, simulated, tmp_path):
    root, episodes = simulated
    action = episodes[0].action.copy()
    action[3] = -action[3]
    wrong = Episode(**{**vars(episodes[0]), "action": action})
    from eisp_data.storage.lerobot import read_spec

    with DatasetWriter(tmp_path / "wrong", read_spec(root), {}) as writer:
        writer.write([wrong])
    status, out, _ = eisp_data("replay", tmp_path / "wrong")
    assert status == 0 and float(out.split()[-1]) > 1e-3


def test_replay_of_a_real_robot_is_refused(eisp_data, make_dataset):
    root, _ = make_dataset(sim_state_dim=0)
    status, _, err = eisp_data("replay", root)
    assert status == 2 and "no simulator states" in err


@pytest.fixture
def drawing():
    """Skip where there is no OpenGL."""
    from eisp_data.sim.render import Renderer

    try:
        Renderer(get_task("stack"), "top", 48, 48).close()
    except ConfigError as error:
        pytest.skip(str(error))


def test_render_adds_images_and_changes_nothing_else(eisp_data, simulated, tmp_path, drawing):
    root, episodes = simulated
    status, *_ = eisp_data("render", root, "--to", tmp_path / "seen", "--cameras", "top")
    assert status == 0
    for ours, theirs in zip(episodes, read_episodes(tmp_path / "seen", images=True), strict=True):
        assert_same(ours, theirs)
        assert theirs.images["top"].shape == (STEPS + 1, 48, 48, 3)
        assert theirs.images["top"].std() > 5
    assert all(check.passed for check in validate(tmp_path / "seen"))
    status, _, err = eisp_data(
        "render", tmp_path / "seen", "--to", tmp_path / "x", "--cameras", "top"
    )
    assert status == 2 and "has it already" in err


def test_view_draws_a_storyboard_and_a_film(eisp_data, simulated, tmp_path, drawing):
    import av
    from PIL import Image

    root, _ = simulated
    status, out, _ = eisp_data("view", root, "--to", tmp_path / "look", "--episode", 1)
    assert status == 0 and len(out.splitlines()) == 2
    assert np.asarray(Image.open(tmp_path / "look/episode-1.png")).std() > 5
    with av.open(str(tmp_path / "look/episode-1.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == STEPS + 1
    status, _, err = eisp_data("view", root, "--episode", 2)
    assert status == 2 and "no episode 2; there are 0 to 1" in err


def test_view_writes_a_rerun_recording_that_rerun_opens(eisp_data, make_dataset, tmp_path):
    pytest.importorskip("rerun", reason="the extra 'view' is not installed")
    root, _ = make_dataset(cameras=True, sim_state_dim=0)
    status, out, _ = eisp_data("view", root, "--to", tmp_path / "look", "--rerun")
    assert status == 0 and len(out.splitlines()) == 3
    said = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "stats", str(tmp_path / "look/episode-0.rrd")],
        env={**os.environ, "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
    ).stdout
    for path in ("camera", "achieved_goal", "desired_goal", "action", "reward"):
        assert f"/{path}: " in said, said


def test_view_shows_the_camera_of_a_real_robot(eisp_data, make_dataset, tmp_path):
    root, _ = make_dataset(cameras=True, sim_state_dim=0)
    assert eisp_data("view", root, "--to", tmp_path / "look")[0] == 0
    assert (tmp_path / "look/episode-0.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("cameras", "words", "said"),
    [
        (False, (), "has neither simulator states nor camera images to draw"),
        (True, ("--camera", "left"), "no camera 'left'; there are ["),
    ],
)
def test_view_of_what_cannot_be_drawn_is_told_before_it_is_read(
    eisp_data, make_dataset, monkeypatch, cameras, words, said
):
    root, _ = make_dataset(cameras=cameras, sim_state_dim=0)
    monkeypatch.setattr("eisp_data.replay.read_episodes", None)
    status, _, err = eisp_data("view", root, *words)
    assert status == 2 and said in err


def test_one_episode_is_shown_without_reading_those_after_it(simulated, monkeypatch):
    root, episodes = simulated

    def first_only(root, images):
        yield episodes[0]
        raise DataError("the next one is damaged")

    monkeypatch.setattr("eisp_data.replay.read_episodes", first_only)
    assert [number for number, _ in chosen_episodes(root, [0])] == [0]


def test_the_subgoal_is_the_end_of_the_part_that_a_step_is_in():
    assert waypoints(6, 3).tolist() == [2, 2, 4, 4, 6, 6, 6]
    assert waypoints(5, 2).tolist() == [2, 2, 5, 5, 5, 5]
    assert waypoints(2, 1).tolist() == [2, 2, 2]


def test_collecting_checking_and_training_need_no_network(tmp_path, monkeypatch, eisp_data):
    from learning_samples import tiny_pretraining

    from eisp_data.cli.collect import CollectConfig, collect
    from pretrain.train import pretrain

    tried = []

    def refuse(*words, **_options):
        tried.append(words)
        raise OSError("the network is off")

    for name in ("connect", "connect_ex", "sendto", "bind"):
        monkeypatch.setattr(socket.socket, name, refuse)
    for name in ("getaddrinfo", "create_connection", "gethostbyname"):
        monkeypatch.setattr(socket, name, refuse)
    root = tmp_path / "stack"
    collect(CollectConfig(output_dir=root, task="stack", policy="oracle", episodes=2, workers=1))
    assert eisp_data("validate", root)[0] == 0
    arrays = load_arrays(root)
    assert arrays.num_episodes == 2
    assert arrays.num_steps == sum(map(len, read_episodes(root)))
    config = tiny_pretraining(root, tmp_path / "run", updates=2, validate_every=2)
    run = pretrain(config)
    assert (run / "checkpoints/last/pretrained_model/model.safetensors").is_file()
    assert tried == []
