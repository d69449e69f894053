"""Recording a robot: deadlines, rates, humans at the controls, and every way to end."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from bench_robot import BenchRobot
from hand_on_device import STAY, HandOnGamepad, HandOnKeyboard
from image_samples import skip_without_opengl

from eisp_data.cli.record import main
from eisp_data.errors import ConfigError, EispError, RobotError
from eisp_data.robots import registry, teleop
from eisp_data.robots.estimates import Estimates, ObjectEstimate
from eisp_data.robots.loop import POLLS, Ticks
from eisp_data.robots.record import RecordConfig, check, record
from eisp_data.robots.record_controllers import Decision, Human, Slowed, Watched
from eisp_data.robots.session import Session
from eisp_data.robots.session_view import HandEyes, Seen, seen
from eisp_data.robots.tool_history import ToolState
from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap.convert import ConvertConfig, convert
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.windows import cut
from eisp_data.tasks.registry import TASKS

PERIOD_S = 0.04


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> type[BenchRobot]:
    """The robot in memory, as ``--robot bench``."""
    entry = type(registry.ROBOTS["twin"])("bench_robot:BenchRobot", "robot")
    monkeypatch.setitem(registry.ROBOTS, "bench", entry)
    monkeypatch.setattr(BenchRobot, "made", [])
    return BenchRobot


def hand_on(monkeypatch: pytest.MonkeyPatch, source: object) -> None:
    monkeypatch.setattr(teleop, "_make", lambda device: source)


def recorded(tmp_path: Path, **options: object) -> RecordConfig:
    return RecordConfig(
        robot="bench", host="none", output=tmp_path / "a.mcap", control="gamepad", **options
    )


def test_deadlines_are_absolute_and_those_that_pass_altogether_are_counted() -> None:
    robot = BenchRobot()
    start, work_s = robot.now_s(), [0.01, 0.05, 0.01, 0.10, 0.01]
    ticks, begun = Ticks(robot, 25.0), []
    for deadline in ticks.run(lambda part: None):
        begun.append((deadline / 1e9 - start) / PERIOD_S)
        if not work_s:
            break
        robot.wait_until(robot.now_s() + work_s.pop(0))
    # 50 ms of work make the next tick 10 ms late; 100 ms leave one out, and the next is late too.
    assert np.round(begun, 6).tolist() == [0, 1, 2, 3, 5, 6]
    timing = ticks.timing()
    assert (timing.ticks, timing.dropped) == (6, 1)
    assert timing.late_max_ms == pytest.approx(20.0, abs=0.01)
    assert timing.late_median_ms == pytest.approx(0.0, abs=0.01)


def test_each_source_is_recorded_at_its_own_rate_with_its_own_time(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=50))
    report = record(recorded(tmp_path))
    assert report.timing is not None and report.timing.dropped == 0
    with McapLog(report.output) as log:
        counts = {topic: stats.count for topic, stats in log.stats().items()}
        images = list(log.messages({"/camera/top/image"}))
        assert log.indexed and not log.problems
    assert counts["/action"] == counts["/joint_command"] == 50
    assert counts["/joint_states"] == pytest.approx(2 * 100, abs=2)
    assert counts["/camera/top/image"] == pytest.approx(2 * 27, abs=2)
    assert report.lost_frames["top"] == pytest.approx(2 * 3, abs=1)
    steps = np.diff([entry.message.publish_time_ns for entry in images]) / 1e9
    assert set(np.round(steps * 30)) == {1.0, 2.0}


@pytest.mark.parametrize(("work_s", "poll"), [(0.005, 1), (0.015, 2), (0.025, 3), (0.035, 0)])
def test_a_tick_that_takes_long_puts_off_the_look_at_the_images_and_never_cancels_it(
    tmp_path: Path,
    bench: type[BenchRobot],
    monkeypatch: pytest.MonkeyPatch,
    work_s: float,
    poll: int,
) -> None:
    class SlowHand(HandOnGamepad):
        def get_action(self) -> dict[str, float]:
            robot = bench.made[0]
            robot.wait_until(robot.now_s() + work_s)
            return super().get_action()

    looked_s: list[float] = []

    def look(self: HandEyes, frames: dict[str, object], reading: object) -> None:
        if frames:
            looked_s.append(bench.made[0].now_s())

    hand_on(monkeypatch, SlowHand(reads=20))
    monkeypatch.setattr(HandEyes, "look", look)
    start_s = BenchRobot().now_s()
    bench.made.clear()
    record(recorded(tmp_path))
    polls = np.round((np.array(looked_s) - start_s) / (PERIOD_S / POLLS))
    assert (polls % POLLS == poll).all()
    # One look a tick; in the first there is no image yet.
    assert (np.diff(polls) == POLLS).all() and len(polls) >= 19


def test_a_teleoperated_session_becomes_a_dataset_of_what_the_hand_did(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=20))
    report = record(recorded(tmp_path, teleop_speed=0.2, operator="ann"))
    convert(ConvertConfig(inputs=(report.output,), to=tmp_path / "data"))
    [episode] = read_episodes(tmp_path / "data")
    assert episode.action.shape == (20, 4) and episode.observation.shape[0] == 21
    [table] = (tmp_path / "data").glob("data/*/*.parquet")
    joints = np.array(pq.read_table(table)["joints"].to_pylist())
    sent = np.array([command.joint_position for command in bench.made[0].sent])
    np.testing.assert_allclose(joints[1:, :6], sent[: len(joints) - 1], atol=1e-6)
    np.testing.assert_allclose(episode.action, np.tile([0.1, 0.05, 0.0, -1.0], (20, 1)), atol=1e-6)
    assert episode.info["outcome"] == "success"
    way = episode.achieved_goal[-1] - episode.achieved_goal[0]
    # Half a deflection at 0.2 m/s for 0.8 s, less what gaining speed takes.
    assert 0.06 < way[0] <= 0.08 and way[1] == pytest.approx(way[0] / 2, abs=0.003)
    assert bench.made[0].sent[-1].gripper_opening_m == 0.0


def test_a_success_that_is_seen_late_in_its_tick_is_marked_in_its_episode(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    def look(self: HandEyes, frames: dict[str, object], reading: object) -> None:
        bench.made[0].wait_until(bench.made[0].now_s() + 0.002)

    hand_on(monkeypatch, HandOnGamepad(reads=100))
    monkeypatch.setattr(HandEyes, "look", look)
    monkeypatch.setattr(Session, "_is_met", lambda self, seen: True)
    report = record(recorded(tmp_path))
    convert(ConvertConfig(inputs=(report.output,), to=tmp_path / "data"))
    [episode] = read_episodes(tmp_path / "data")
    assert (episode.info["outcome"], episode.info["success_mark"]) == ("success", True)


def test_directions_of_the_keyboard_are_those_of_the_table_and_a_held_key_counts_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = HandOnKeyboard()
    hand_on(monkeypatch, source)
    keyboard = teleop.Teleop("keyboard")
    first, second = keyboard.read(), keyboard.read()
    assert first.motion.tolist() == [1.0, 0.0, 0.0] and first.takes_over
    assert (first.outcome, second.outcome) == ("success", None)
    assert source.current_pressed == {"up": True}
    keyboard.close()
    with pytest.raises(RobotError, match="keyboard: disconnected"):
        keyboard.read()


class Moves:
    """Moves by one whole displacement at a time, and squeezes; may want a look first."""

    name = "moves"

    def __init__(self, looking: bool = False) -> None:
        self._looking, self.decided = looking, 0

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        self.decided = 0

    def act(self, seen: Seen) -> Decision:
        self.decided += 1
        return Decision(np.array([1.0, 0.0, 0.0, -1.0]), looking=self._looking)


class HandThatTakesOver(HandOnGamepad):
    """Leaves the fingers alone; has the controls in those reads that are named."""

    def __init__(self, reads: set[int]) -> None:
        super().__init__(reads=100)
        self._reads, self._read = reads, -1

    def get_action(self) -> dict[str, object]:
        self._read += 1
        self._takes_over = self._read in self._reads
        return super().get_action() | {"gripper": STAY}


@pytest.fixture
def at_rest() -> Seen:
    """Stack's table; what is between the fingers keeps them half open."""
    tool = ToolState(0.0, np.eye(4), np.zeros(3), np.zeros(3), 0.04, 0.0)
    block = ObjectEstimate(np.eye(4), np.zeros(3), np.zeros(3), 0.0, held=False)
    return seen(TASKS["stack"], 0.0, Estimates(tool, {f"block{i}": block for i in range(3)}))


def watched(monkeypatch: pytest.MonkeyPatch, inner: Moves, reads: set[int], at: Seen) -> Watched:
    hand_on(monkeypatch, HandThatTakesOver(reads))
    human = Human(teleop.Teleop("gamepad"), speed=1.0)
    controller = Watched(Slowed(inner, TASKS["stack"], ticks=2), human)
    controller.begin(at, np.zeros(9), 0)
    return controller


def test_who_takes_over_keeps_hold_and_who_gets_it_back_decides_anew(
    monkeypatch: pytest.MonkeyPatch, at_rest: Seen
) -> None:
    inner = Moves()
    controller = watched(monkeypatch, inner, {1, 2}, at_rest)
    decided, decisions = [], []
    for _ in range(6):
        decisions.append(controller.act(at_rest))
        decided.append(inner.decided)
    assert [each.by_human for each in decisions] == [False, True, True, False, False, False]
    # Its fingers' last command, which squeezes, not where they are.
    assert [each.action[3] for each in decisions] == [-1.0] * 6
    # The second half of the first displacement was for where the arm was before.
    assert decided == [1, 1, 1, 2, 2, 3]


def test_who_takes_over_after_a_look_finds_the_fingers_open(
    monkeypatch: pytest.MonkeyPatch, at_rest: Seen
) -> None:
    controller = watched(monkeypatch, Moves(looking=True), {1}, at_rest)
    decisions = [controller.act(at_rest) for _ in range(2)]
    assert [each.looking for each in decisions] == [True, False]
    assert decisions[1].action[3] == 1.0


@pytest.mark.parametrize("device", ["keyboard", "gamepad"])
def test_a_device_that_is_not_there_is_one_line(device: teleop.Device) -> None:
    with pytest.raises(EispError) as error:
        teleop.Teleop(device)
    assert str(error.value).startswith(device) and "\n" not in str(error.value)


def end_of(path: Path) -> tuple[bool, list[str], int]:
    """Return whether a recording has its index, how its episodes ended, and its actions."""
    from eisp_data.storage.mcap import decode

    decoder, events = decode.Decoder(), []
    with McapLog(path) as log:
        for entry in log.messages({"/events"}):
            events.append(
                decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
            )
        count = log.stats()["/action"].count
        assert not log.problems
        windows = cut(events, 0, 0)
        assert all(window.complete for window in windows)
        return log.indexed, [window.outcome for window in windows], count


def test_a_camera_that_is_unplugged_leaves_a_standing_robot_and_a_closed_log(
    tmp_path: Path,
    bench: type[BenchRobot],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=100))
    monkeypatch.setattr(BenchRobot, "unplugs_after_s", 11.0)
    with pytest.raises(RobotError, match="camera 'top' is unplugged"):
        record(recorded(tmp_path))
    assert bench.made[0].standing and not bench.made[0].connected
    assert end_of(tmp_path / "a.mcap") == (True, [""], 26)
    assert "26 ticks at 25 Hz" in capsys.readouterr().out


class HandThatSignals(HandOnGamepad):
    """Presses Ctrl-C, or sends another signal, in its tenth tick."""

    def __init__(self, number: signal.Signals, reads: int = 100) -> None:
        super().__init__(reads)
        self._number, self._read = number, 0

    def get_action(self) -> dict[str, float]:
        self._read += 1
        if self._read == 10:
            os.kill(os.getpid(), self._number)
        return super().get_action()


def test_ctrl_c_ends_between_two_ticks_with_a_standing_robot_and_a_closed_log(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_on(monkeypatch, HandThatSignals(signal.SIGINT))
    before = signal.getsignal(signal.SIGINT)
    report = record(recorded(tmp_path, episodes=3))
    assert [ended.outcome for ended in report.episodes] == [""]
    assert bench.made[0].standing and not bench.made[0].connected
    assert end_of(tmp_path / "a.mcap") == (True, [""], 10)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("hand", "status", "said"),
    [
        (HandOnGamepad(reads=5), 0, ""),
        (HandThatSignals(signal.SIGINT), 130, "stopped by SIGINT\n"),
        (HandThatSignals(signal.SIGTERM), 143, "stopped by SIGTERM\n"),
        # With the read that ends the first episode as a success: the second is not begun.
        (HandThatSignals(signal.SIGINT, reads=9), 130, "stopped by SIGINT\n"),
    ],
)
def test_a_command_that_comes_after_a_stopped_one_is_not_begun(
    tmp_path: Path,
    bench: type[BenchRobot],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    hand: HandOnGamepad,
    status: int,
    said: str,
) -> None:
    hand_on(monkeypatch, hand)
    words = "--robot bench --host none --control gamepad --episodes 2 --pause-s 0 --output"
    monkeypatch.setattr("sys.argv", ["eisp-record", *words.split(), str(tmp_path / "a.mcap")])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == status
    assert capsys.readouterr().out.endswith(f"0 dropped\n{said}")
    assert bench.made[0].standing


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ({}, "--task stack: bench has no camera"),
        ({"top": None}, "camera 'top' gives no image"),
    ],
)
def test_a_camera_that_gives_nothing_is_told_before_anything_is_written(
    tmp_path: Path,
    bench: type[BenchRobot],
    monkeypatch: pytest.MonkeyPatch,
    cameras: dict[str, None],
    said: str,
) -> None:
    def connect(self: BenchRobot) -> None:
        self.cameras = cameras

    hand_on(monkeypatch, HandOnGamepad(reads=5))
    monkeypatch.setattr(BenchRobot, "connect", connect)
    monkeypatch.setattr(BenchRobot, "frames", lambda self: {})
    with pytest.raises(EispError, match=said):
        record(recorded(tmp_path, task="stack"))
    assert bench.made[0].standing and list(tmp_path.iterdir()) == []


def test_only_an_enter_after_the_words_starts_the_next_episode(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, terminal = os.openpty()
    read_s: list[float] = []

    class HandThatLeansOnEnter(HandOnGamepad):
        def get_action(self) -> dict[str, float]:
            os.write(keys, b"\n")
            read_s.append(time.monotonic())
            return super().get_action()

    class Operator(io.StringIO):
        """Reads the words; ends the input, which is no enter, and presses it a moment later."""

        def write(self, text: str) -> int:
            if "press enter" in text:
                os.write(keys, b"\x04")
                threading.Timer(0.4, os.write, (keys, b"\n")).start()
            return super().write(text)

    hand_on(monkeypatch, HandThatLeansOnEnter(reads=5))
    monkeypatch.setattr("sys.stderr", Operator())
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        report = record(recorded(tmp_path, episodes=2, pause_s=30.0))
    os.close(keys)
    assert [ended.ticks for ended in report.episodes] == [5, 0]
    assert 0.4 < read_s[6] - read_s[5] < 20


def test_an_error_of_our_own_leaves_a_standing_robot_and_a_closed_log(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=100))

    def fail(self: Session, *_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Session, "_note", fail)
    with pytest.raises(ZeroDivisionError):
        record(recorded(tmp_path))
    assert bench.made[0].standing and not bench.made[0].connected
    with McapLog(tmp_path / "a.mcap") as log:
        assert log.indexed and not log.problems


@pytest.mark.parametrize(("presses", "moves"), [(0.3, True), (0.8, False)])
def test_an_arm_that_presses_too_hard_gives_way(
    tmp_path: Path,
    bench: type[BenchRobot],
    monkeypatch: pytest.MonkeyPatch,
    presses: float,
    moves: bool,
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=10))
    monkeypatch.setattr(BenchRobot, "presses", presses)
    record(recorded(tmp_path))
    sent = np.array([command.joint_position for command in bench.made[0].sent])
    assert (np.ptp(sent, axis=0).max() > 0.01) == moves


def test_a_dry_run_commands_nothing(
    tmp_path: Path, bench: type[BenchRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    hand_on(monkeypatch, HandOnGamepad(reads=10))
    report = record(recorded(tmp_path, dry_run=True))
    assert not bench.made[0].sent and bench.made[0].standing
    assert end_of(report.output)[2] == 10


def test_a_script_on_the_twin_becomes_a_dataset_in_the_layout_of_its_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pinocchio")
    skip_without_opengl()
    # A hand that has the gamepad's button down from the start: what it does is an intervention.
    hand_on(monkeypatch, HandOnGamepad(reads=100, takes_over=True))
    options = {"task": "stack", "realtime": False, "episode_s": 0.4, "seed": 7}
    record(RecordConfig(output=tmp_path / "a.mcap", **options))
    watched = RecordConfig(output=tmp_path / "b.mcap", watch="gamepad", **options)
    record(watched)
    convert(ConvertConfig(inputs=(tmp_path / "a.mcap", watched.output), to=tmp_path / "data"))
    with McapLog(tmp_path / "a.mcap") as log:
        assert log.stats()["/objects"].count == log.stats()["/achieved_goal"].count == 11
    alone, helped = read_episodes(tmp_path / "data")
    for episode in (alone, helped):
        assert episode.observation.shape == (11, 55) and episode.action.shape == (10, 4)
        assert episode.info["outcome"] == "timeout" and episode.info["task"] == "stack"
    # Perceived, not given: near the true start of that seed, but not the same to the digit.
    true_blocks = TASKS["stack"].block_positions(
        TASKS["stack"].reset(np.random.default_rng(7))[0][None]
    )
    off = np.linalg.norm(alone.achieved_goal[0].reshape(3, 3) - true_blocks[0], axis=1)
    assert (off > 0).all() and (off < 0.008).all()
    assert (alone.info["interventions"], helped.info["interventions"]) == (0, 1)
    np.testing.assert_allclose(helped.action[:, 3], -1.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"control": "magic"}, "choose one of keyboard, gamepad, script"),
        ({"control": "script", "task": None}, "missing --task"),
        ({"episodes": 0}, "--episodes must be at least 1; got 0"),
        ({"teleop_speed": 2.0}, "--teleop-speed"),
        ({"episode_s": float("nan")}, "--episode-s"),
    ],
)
def test_settings_that_cannot_be_used_are_one_line(
    tmp_path: Path, options: dict[str, object], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        check(RecordConfig(**{"output": tmp_path / "a.mcap", "task": "stack", **options}))


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match="exists already"):
        check(RecordConfig(output=tmp_path / "a.mcap", task="stack"))
