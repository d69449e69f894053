"""Deployment: what stands between a policy and a robot, what is drawn of it, and who interferes."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from image_samples import skip_without_opengl

from eisp_data.config import save_yaml
from eisp_data.errors import ConfigError
from eisp_data.robots.calibration import CameraCalibration
from eisp_data.robots.cell import transform_camera_to_task
from eisp_data.robots.estimates import Estimates, ObjectEstimate
from eisp_data.robots.pose import View
from eisp_data.robots.record_controllers import Decision, Limited, Slowed
from eisp_data.robots.robot import CameraIntrinsics
from eisp_data.robots.session_view import Seen, seen
from eisp_data.robots.tool_history import ToolState
from eisp_data.sim.scene import BLOCK_SIZE_M, FINGER_TRAVEL_M
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.writer import McapWriter
from eisp_data.tasks.base import ACTION_SCALE_M
from eisp_data.tasks.registry import TASKS
from finetune.cli.deploy import main
from finetune.config import PolicyConfig
from finetune.deploy import RESULTS, SETTINGS, deploy
from finetune.deploy_config import DeployConfig
from finetune.deploy_film import draw, film
from finetune.deploy_policy import Looking
from finetune.deploy_trace import distance_curve, read_traces
from finetune.disturb import Hand
from pretrain.config import SubgoalConfig

STACK = TASKS["stack"]
BLOCKS_M = np.array([[0.30, -0.10, 0.025], [0.30, 0.0, 0.025], [0.30, 0.10, 0.025]])
START_NS, SECOND_NS = 1_700_000_000_000_000_000, 1_000_000_000


def seen_at(
    gripper_m: np.ndarray, opening_m: float, at_s: float = 0.0, velocity: float = 0.0
) -> Seen:
    pose = np.eye(4)
    pose[:3, 3] = gripper_m
    tool = ToolState(at_s, pose, np.full(3, velocity), np.zeros(3), opening_m, 0.0)
    blocks = {}
    for number, place in enumerate(BLOCKS_M):
        there = np.eye(4)
        there[:3, 3] = place
        blocks[f"block{number}"] = ObjectEstimate(there, np.zeros(3), np.zeros(3), 0.0, False)
    return seen(STACK, at_s, Estimates(tool, blocks))


class Inner:
    """Always moves forward by one whole displacement; remembers what it was shown."""

    name = "inner"

    def __init__(self) -> None:
        self.shown: list[Seen] = []
        self.at_subgoal, self.replanned = False, 0

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        self.shown.clear()

    def replan(self) -> None:
        self.replanned += 1

    def act(self, seen: Seen) -> Decision:
        self.shown.append(seen)
        return Decision(np.array([1.0, 0.0, 0.0, -1.0]))


def test_a_slowed_policy_sees_its_own_speeds_and_moves_as_far_in_more_time() -> None:
    inner = Inner()
    slowed = Slowed(inner, STACK, ticks=3)
    slowed.begin(seen_at(np.array([0.3, 0, 0.2]), 0.08, at_s=7.0), np.zeros(9), 0)
    way = np.zeros(3)
    for tick in range(9):
        now = seen_at(np.array([0.3, 0, 0.2]), 0.08, at_s=7.0 + 0.04 * tick, velocity=0.1)
        way += ACTION_SCALE_M * slowed.act(now).action[:3]
    np.testing.assert_allclose(way, [3 * ACTION_SCALE_M, 0, 0])
    assert len(inner.shown) == 3
    np.testing.assert_allclose(inner.shown[1].observation[5:8], 0.3, rtol=1e-6)
    assert inner.shown[1].state[0] == pytest.approx(7.0 + 0.04)


def test_a_look_is_no_step_of_the_task_and_after_it_the_policy_decides_at_once() -> None:
    class Looks(Inner):
        def act(self, seen: Seen) -> Decision:
            return replace(super().act(seen), looking=len(self.shown) == 3)

    inner = Looks()
    controller = Slowed(Limited(inner, steps=5), STACK, ticks=2)
    now = seen_at(np.array([0.3, 0, 0.2]), 0.08)
    controller.begin(now, np.zeros(9), 0)
    decisions = [controller.act(now) for _ in range(12)]
    assert [each.looking for each in decisions] == [False] * 4 + [True] + [False] * 7
    # Two ticks for each of five steps, and one for the look.
    assert [each.outcome for each in decisions] == [None] * 11 + ["timeout"]
    assert len(inner.shown) == 7


def test_the_policy_looks_after_a_subgoal_once_it_has_let_go_and_come_away() -> None:
    inner = Inner()
    looking = Looking(inner, STACK)
    block, above = BLOCKS_M[1], BLOCKS_M[1] + [0.0, 0.0, 0.06]
    held, beside = seen_at(block, BLOCK_SIZE_M), seen_at(block, 2 * FINGER_TRAVEL_M)
    looking.begin(held, np.zeros(9), 0)
    for step in range(20):
        inner.at_subgoal = step == 12
        assert not looking.act(held).looking
    # Perhaps it is still pushing.
    assert not any(looking.act(beside).looking for _ in range(20))
    decisions = [looking.act(seen_at(above, 2 * FINGER_TRAVEL_M)) for _ in range(6)]
    assert [decision.looking for decision in decisions].count(True) == 1


@pytest.mark.parametrize(("moved_m", "replans"), [(0.0, 0), (0.03, 1)])
def test_the_policy_plans_anew_where_a_look_shows_something_else_than_was_believed(
    moved_m: float, replans: int
) -> None:
    inner = Inner()
    looking = Looking(inner, STACK)
    now = seen_at(np.array([0.3, 0.0, 0.2]), 2 * FINGER_TRAVEL_M)
    looking.begin(now, np.zeros(9), 0)
    inner.at_subgoal = True
    while not looking.act(now).looking:
        assert inner.replanned == 0 and len(inner.shown) < 50
    shown = replace(now, achieved_goal=now.achieved_goal + moved_m)
    looking.act(shown)
    looking.act(shown)
    assert inner.replanned == replans


def test_the_policy_plans_anew_as_soon_as_somebody_moves_a_block() -> None:
    inner = Inner()
    looking = Looking(inner, STACK)
    now = seen_at(np.array([0.3, 0.0, 0.2]), 2 * FINGER_TRAVEL_M)
    looking.begin(now, np.zeros(9), 0)
    looking.act(now)
    moved = now.achieved_goal.copy()
    moved[4] += 0.2
    looking.act(replace(now, achieved_goal=moved))
    assert inner.replanned == 1
    # What the arm moves itself is no surprise.
    held = seen_at(moved.reshape(-1, 3)[1], BLOCK_SIZE_M)
    looking.act(replace(held, achieved_goal=moved))
    looking.act(replace(held, achieved_goal=now.achieved_goal))
    assert inner.replanned == 1


def test_what_is_at_its_goal_and_held_there_is_let_go_of() -> None:
    looking = Looking(Inner(), STACK)
    held = seen_at(BLOCKS_M[1], BLOCK_SIZE_M)
    looking.begin(held, held.achieved_goal, 0)
    decisions = [looking.act(held) for _ in range(40)]
    first = next(step for step, decision in enumerate(decisions) if decision.looking)
    assert 20 <= first <= 30


def test_what_is_believed_at_its_goal_but_out_of_sight_is_looked_at() -> None:
    looking = Looking(Inner(), STACK)
    now = seen_at(np.array([0.3, 0.0, 0.2]), 2 * FINGER_TRAVEL_M)
    looking.begin(now, now.achieved_goal, 0)
    assert not any(looking.act(now).looking for _ in range(20))
    hidden = replace(now.estimates.objects["block0"], age_s=1.0)
    objects = {**now.estimates.objects, "block0": hidden}
    unseen = replace(now, estimates=replace(now.estimates, objects=objects))
    assert [looking.act(unseen).looking for _ in range(5)] == [False] * 4 + [True]


def test_a_policy_that_stands_still_looks_and_plans_anew_and_one_that_goes_on_does_not() -> None:
    inner = Inner()
    looking = Looking(inner, STACK)
    place, moving = np.array([0.3, 0.0, 0.2]), np.array([0.0, 0.002, 0.0])
    looking.begin(seen_at(place, BLOCK_SIZE_M), np.zeros(9), 0)
    assert not any(
        looking.act(seen_at(place + step * moving, BLOCK_SIZE_M)).looking for step in range(80)
    )
    # To and fro is no way on either.
    hovering = [place + (step % 2) * 5 * moving for step in range(90)]
    looks = [looking.act(seen_at(there, BLOCK_SIZE_M)).looking for there in hovering]
    assert looks.count(True) == 2 and inner.replanned == 2


def camera_view() -> View:
    lens = CameraIntrinsics(640, 480, np.array([[920.0, 0, 319.5], [0, 920.0, 239.5], [0, 0, 1.0]]))
    return View(CameraCalibration(lens, transform_camera_to_task()), np.eye(4))


def test_subgoals_are_drawn_where_the_camera_would_see_them() -> None:
    view = camera_view()
    grey = np.full((480, 640, 3), 90, np.uint8)
    colours = [np.array([255.0, 0.0, 0.0])]
    drawn = draw(grey, view, np.array([0.30, 0.12, 0.025]), np.array([0.30, 0.0, 0.025]), colours)
    changed = np.argwhere((drawn != 90).any(axis=2))[:, ::-1]
    [cube, ball] = view.project(np.array([[0.30, 0.0, 0.025], [0.30, 0.12, 0.025]]))
    near = np.minimum(
        np.linalg.norm(changed - cube, axis=1), np.linalg.norm(changed - ball, axis=1)
    )
    # Half the diagonal of the cube, from 0.85 m.
    assert near.max() < 1.1 * 920 * BLOCK_SIZE_M * 0.87 / 0.85
    for place in (cube, ball):
        x, y = place.round().astype(int)
        assert drawn[y, x, 0] > drawn[y, x, 1]
    assert (grey == 90).all()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds, one subgoal in each, the goal 0.3 m away and coming nearer by 0.1 m/s."""
    path = tmp_path_factory.mktemp("deploy") / "session.mcap"
    goal = np.tile([0.3, 0.0, 0.025], 3)
    with McapWriter(path) as log:
        log.event("episode_start", START_NS)
        log.vector("/desired_goal", goal, START_NS)
        for tick in range(51):
            at = START_NS + tick * SECOND_NS // 25
            off = np.tile([0.0, 0.3 - 0.1 * tick / 25, 0.0], 3)
            log.vector("/achieved_goal", goal + off, at)
            log.vector("/subgoal", goal + (0.1 if tick < 25 else 0.0), at)
        for number in (n for n in range(60) if not 20 <= n < 30):
            image = np.full((48, 64, 3), number, np.uint8)
            log.image("/camera/top/image", image, START_NS + number * SECOND_NS // 30)
        log.event("episode_end", START_NS + 2 * SECOND_NS)
        # The look before the next one failed: an end without a start.
        log.event("episode_end", START_NS + 20 * SECOND_NS)
    return path


def test_distances_and_subgoals_are_read_back_from_a_recording(recording: Path) -> None:
    [trace] = read_traces(recording)
    np.testing.assert_allclose(trace.distances_m()[[0, 25, 50]], [0.3, 0.2, 0.1], atol=1e-9)
    assert len(trace.subgoals) == 2
    assert trace.subgoal_at(START_NS - 1) is None
    np.testing.assert_allclose(
        trace.subgoal_at(START_NS + SECOND_NS // 2), trace.goal + 0.1, atol=1e-9
    )
    curve = distance_curve([trace], 7, 0.05)
    assert curve.startswith("<svg") and "polyline" in curve
    assert "0.05 m" in curve and "episode 7" in curve


def test_a_film_lasts_as_long_as_its_episode_also_where_images_were_lost(
    recording: Path, tmp_path: Path
) -> None:
    import av

    [trace] = read_traces(recording)
    count = film(recording, trace, "top", camera_view(), STACK, tmp_path / "film.mp4")
    assert count == 60
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 60


def test_the_hand_takes_one_finished_block_away_once_and_to_a_free_place() -> None:
    pytest.importorskip("pinocchio")
    from eisp_data.robots.twin.robot import TwinRobot

    referee = TwinRobot("stack").referee
    for seed in range(5):
        goal = referee.reset(seed)
        hand = Hand(referee, STACK)
        hand.begin(goal, seed)
        now, decision = seen_at(np.array([0.3, 0, 0.3]), 0.08), Decision(np.zeros(4))
        for step in range(10):
            hand(step, now, decision)
        assert not hand.moved
        for block, place in enumerate(goal.reshape(-1, 3)):
            referee.move_block(block, place)
        for step in range(4):
            hand(step, now, decision)
            assert referee.success(goal)
        for step in range(20):
            hand(step, now, decision)
        assert hand.moved
        away = np.linalg.norm((referee.achieved_goal() - goal).reshape(-1, 3), axis=1)
        assert (away > 0.05).tolist() == [False, False, True]


def test_the_hand_comes_before_any_success_however_far_off_a_single_block_is() -> None:
    pytest.importorskip("pinocchio")
    from eisp_data.robots.twin.robot import TwinRobot

    task = TASKS["store"]
    referee = TwinRobot("store").referee
    goal = referee.reset(0)
    referee.move_block(0, goal[:3] + [0.0, 0.042, 0.0])
    assert referee.success(goal)
    hand = Hand(referee, task)
    hand.begin(goal, 0)
    hand_off, decision = seen_at(np.array([0.3, 0, 0.3]), 0.08), Decision(np.zeros(4))
    for step in range(8):
        hand(step, hand_off, decision)
    assert hand.moved and not referee.success(goal)


def config_for(tmp_path: Path, policy: Path | None, **options: object) -> DeployConfig:
    settings = {"task": "stack", "output_dir": tmp_path / "out", "realtime": False, **options}
    return DeployConfig(policy=PolicyConfig(policy), **settings)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "push4"}, "is a policy of 'stack', not of 'push4'"),
        ({"task": None}, "missing --task"),
        ({"task": "juggle"}, "unknown task 'juggle'"),
        ({"robot": "ur3", "interference": True}, "only the twin has such a hand"),
        ({"robot": "ur4"}, "unknown robot 'ur4'; choose one of twin, ur3, tiago"),
        ({"robot": "ur3"}, "missing --host"),
        ({"calibration": Path("nowhere.yaml")}, "nowhere.yaml"),
        ({"seed": 1_000_000}, "episodes from 1000000 on are learned from"),
        ({"episodes": 0}, "--episodes must be at least 1"),
        ({"subgoals": SubgoalConfig(source="oracle")}, "source oracle needs a simulator"),
    ],
)
def test_what_cannot_be_deployed_is_one_line(
    tmp_path: Path, pretrained: Path, options: dict[str, object], said: str
) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        deploy(config_for(tmp_path, pretrained, **options))
    assert "\n" not in str(error.value)


def test_a_policy_on_the_twin_is_recorded_judged_and_goes_on_where_it_stopped(
    tmp_path: Path, pretrained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skip_without_opengl()
    config = config_for(tmp_path, pretrained, episode_s=0.6, seed=3, device="auto")
    deploy(config)
    with pytest.raises(ConfigError, match="add --resume"):
        deploy(config)
    deploy(replace(config, episodes=2, resume=True, record_images=False))
    entries = [json.loads(line) for line in (config.output_dir / RESULTS).read_text().splitlines()]
    assert [entry["seed"] for entry in entries] == [3, 4]
    assert all(entry["outcome"] == "timeout" and not entry["success"] for entry in entries)
    out = capsys.readouterr().out
    assert "success, by the twin's referee: 0 [0, 0.658] of 2 episodes" in out
    names = {path.name for path in config.output_dir.iterdir()}
    assert {"episode_0000.mp4", "session_0000.svg", "session_0001.svg"} <= names
    with McapLog(config.output_dir / "session_0000.mcap") as log:
        assert log.indexed and not log.problems
        assert log.stats()["/action"].count == 15
        assert {"/subgoal", "/camera/top/image", "/joint_command"} <= set(log.topics)


def test_a_deployment_that_could_not_begin_leaves_nothing_in_the_way_of_another(
    tmp_path: Path, pretrained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pinocchio")

    def no_opengl(width: int, height: int) -> None:
        raise ConfigError("cannot render")

    monkeypatch.setattr("eisp_data.sim.offscreen.open_gl", no_opengl)
    for realtime in (False, True):
        with pytest.raises(ConfigError, match="cannot render"):
            deploy(config_for(tmp_path, pretrained, realtime=realtime))
        assert not (tmp_path / "out").exists()


def test_a_command_that_comes_after_a_stopped_one_is_not_begun(
    tmp_path: Path, pretrained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pinocchio")
    skip_without_opengl()

    def press_ctrl_c(run: object, step: int, seen: Seen, decision: Decision) -> None:
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("finetune.deploy._Run.watch", press_ctrl_c)
    words = ["--task", "stack", "--no-realtime", "--no-record-images", "--episodes", "2"]
    paths = ["--policy.path", str(pretrained), "--output-dir", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", ["eisp-deploy", *words, *paths])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 128 + signal.SIGINT
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".yaml", ".mcap", ".svg"}


def begun(tmp_path: Path, policy: Path | None, results: str, **options: object) -> DeployConfig:
    """Return settings to resume a deployment with that has left these results."""
    config = config_for(tmp_path, policy, **options)
    config.output_dir.mkdir()
    save_yaml(config, config.output_dir / SETTINGS)
    (config.output_dir / RESULTS).write_text(results)
    return replace(config, resume=True)


def test_other_episodes_are_not_added_to_those_there_are(tmp_path: Path, pretrained: Path) -> None:
    config = begun(tmp_path, pretrained, "{}\n", seed=3)
    with pytest.raises(
        ConfigError, match=r"was begun with another --seed, --control, --look; give the"
    ):
        deploy(replace(config, control="script", seed=77, look=False))


def test_an_episode_that_was_cut_off_is_done_again_and_its_recording_kept(
    tmp_path: Path, pretrained: Path
) -> None:
    skip_without_opengl()
    config = begun(tmp_path, pretrained, '{"seed": 0, "succ', episode_s=0.2, record_images=False)
    recording = config.output_dir / "session_0000.mcap"
    recording.write_bytes(b"cut off")
    deploy(config)
    [entry] = [json.loads(line) for line in (config.output_dir / RESULTS).read_text().splitlines()]
    assert (entry["episode"], entry["outcome"]) == (0, "timeout")
    assert recording.read_bytes() == b"cut off"
    with McapLog(config.output_dir / "session_0001.mcap") as log:
        assert log.indexed and not log.problems


def test_an_unreachable_goal_is_refused_before_anything_moves(
    tmp_path: Path, pretrained: Path
) -> None:
    skip_without_opengl()
    from eisp_data.errors import RobotError

    goal = (0.3, 0.0, 0.025, 0.3, 0.0, 0.075, 0.9, 0.0, 0.125)
    with pytest.raises(RobotError, match="unreachable goal"):
        deploy(config_for(tmp_path, pretrained, goal=goal))
    assert not list((tmp_path / "out").glob("*.mcap"))
