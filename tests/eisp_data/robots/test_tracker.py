"""What is believed about the table is the truth, to millimetres, also where none can see it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from eisp_data.errors import RobotError
from eisp_data.robots import cell
from eisp_data.robots.aruco import Detections
from eisp_data.robots.estimates import Estimates, ObjectEstimate, upright
from eisp_data.robots.kinematics import kinematics
from eisp_data.robots.loop import POLLS
from eisp_data.robots.markers import marked_objects
from eisp_data.robots.pose import PoseFit, View
from eisp_data.robots.robot import CameraFrame, JointCommand, Reading
from eisp_data.robots.session_view import seen
from eisp_data.robots.tool_history import ToolHistory, ToolState
from eisp_data.robots.tracker import Tracker
from eisp_data.robots.tracks import BlockTrack
from eisp_data.robots.twin.camera import CAMERA, CameraOptions
from eisp_data.robots.twin.robot import TwinRobot
from eisp_data.sim.drawer import HANDLE_CLOSED_M, HANDLE_GAP_M, TRAY_CENTRE_M
from eisp_data.tasks.registry import TASKS, get_task

TICK_S = 0.04


class Session:
    """A twin and its tracker, ticking together."""

    def __init__(self, robot: TwinRobot) -> None:
        self.robot = robot
        self.tracker = Tracker(robot.task, robot.calibration, CAMERA, robot.arm)
        self.target = np.array(cell.HOME_RAD)
        self.opening_m = robot.limits.gripper_m[1]

    def run(self, ticks: int, blind: bool = False) -> Estimates:
        """Return what is believed after so many ticks."""
        for _ in range(ticks):
            self.robot.command(JointCommand(self.target, self.opening_m))
            start = self.robot.now_s()
            for part in range(1, POLLS):
                self.robot.wait_until(start + part / POLLS * TICK_S)
                self.tracker.update(self.robot.observe())
            self.robot.wait_until(start + TICK_S)
            frame = None if blind else self.robot.frames().get(CAMERA)
            estimates = self.tracker.update(self.robot.observe(), frame)
        return estimates

    def go(self, place: list[float], ticks: int, blind: bool = False) -> Estimates:
        """Return what is believed after the tool has gone straight to (3,) m."""
        placed = cell.transform_task_to_base()
        arm = kinematics("ur3")
        start = cell.apply(cell.inverse(placed), arm.forward(self.target)[:3, 3])
        for share in np.linspace(0, 1, ticks + 1)[1:]:
            there = start + share * (np.array(place) - start)
            self.target = arm.track(placed @ cell.transform(np.eye(3), there), self.target)
            estimates = self.run(1, blind)
        return estimates

    def go_and_wait(self, place: list[float], ticks: int, blind: bool = False) -> Estimates:
        """Return what is believed once the arm stands there."""
        self.go(place, ticks, blind)
        return self.run(3, blind)

    def error_m(self, estimates: Estimates, name: str) -> float:
        """Return how far an estimate is off."""
        believed = estimates.objects[name].transform_object_to_task[:3, 3]
        return float(np.linalg.norm(believed - self.robot.referee.object_pose(name)[:3, 3]))


@pytest.mark.parametrize("name", TASKS)
def test_everything_on_the_table_is_found_and_the_observation_is_the_simulators(name):
    with TwinRobot(name, seed=1) as robot:
        session = Session(robot)
        estimates = session.run(6)
        session.tracker.check()
        assert session.tracker.missing() == []
        for thing in estimates.objects:
            assert session.error_m(estimates, thing) < 0.003
        now = seen(robot.task, robot.now_s(), estimates)
        truth = robot.referee.state()[None]
        np.testing.assert_allclose(
            now.achieved_goal, robot.task.achieved_goal(truth)[0], atol=0.003
        )
        # The orientations among them: within a degree and a half.
        np.testing.assert_allclose(now.observation, robot.task.observe(truth)[0], atol=0.025)
        assert now.observation.dtype == now.achieved_goal.dtype == np.float32


def about_to_grasp_the_first_block(robot: TwinRobot) -> Session:
    """Return a session whose open fingers are around block 0, the others out of the way."""
    robot.referee.move_block(0, np.array([0.30, 0.0, 0.025]))
    robot.referee.move_block(1, np.array([0.38, 0.14, 0.025]))
    robot.referee.move_block(2, np.array([0.38, -0.14, 0.025]))
    session = Session(robot)
    session.run(5)
    session.go_and_wait([0.30, 0.0, 0.025], 12)
    return session


def test_a_held_block_is_known_for_two_seconds_without_any_image():
    with TwinRobot(seed=0) as robot:
        session = about_to_grasp_the_first_block(robot)
        session.opening_m = 0.0
        assert session.run(6).objects["block0"].held
        session.go_and_wait([0.30, 0.0, 0.12], 12, blind=True)
        session.go_and_wait([0.26, 0.10, 0.12], 20, blind=True)
        estimates = session.go_and_wait([0.26, 0.10, 0.030], 18, blind=True)
        assert robot.referee.object_pose("block0")[1, 3] > 0.09, "it was carried"
        assert estimates.objects["block0"].age_s > 2.0
        assert session.error_m(estimates, "block0") < 0.005
        session.opening_m = 0.08
        estimates = session.run(6, blind=True)
        assert not estimates.objects["block0"].held
        assert session.error_m(estimates, "block0") < 0.005
        estimates = session.go_and_wait([0.26, 0.10, 0.10], 8)
        assert estimates.objects["block0"].age_s < 0.1
        assert session.error_m(estimates, "block0") < 0.003


@pytest.mark.parametrize("rise_m", [0.08, 0.14])
def test_an_arm_in_a_hurry_takes_a_block_no_further_than_its_fingers_do(rise_m):
    with TwinRobot(seed=0) as robot:
        session = about_to_grasp_the_first_block(robot)
        # It rises while the fingers are on their way, and no image tells what became of the block.
        session.opening_m = 0.0
        session.run(2, blind=True)
        estimates = session.go([0.30, 0.0, 0.025 + rise_m], 8, blind=True)
        assert robot.referee.object_pose("block0")[2, 3] > 0.05, "it was lifted"
        assert session.error_m(estimates, "block0") < 0.003
        session.go_and_wait([0.26, 0.08, 0.030], 12, blind=True)
        session.opening_m = 0.08
        estimates = session.go([0.26, 0.08, 0.030 + rise_m], 8, blind=True)
        assert not estimates.objects["block0"].held
        assert session.error_m(estimates, "block0") < 0.005


@pytest.mark.parametrize("hidden", [False, True])
def test_a_block_in_a_drawer_that_the_fingers_shut_is_where_the_drawer_is_now(hidden, monkeypatch):
    with TwinRobot("store", seed=0) as robot:
        robot.referee.move_block(0, np.array([TRAY_CENTRE_M[0] - 0.12, 0.0, 0.040]))
        robot.referee._world.data.joint("drawer").qpos[0] = 0.12
        session = Session(robot)
        session.opening_m = 0.0
        session.run(8)
        between = HANDLE_CLOSED_M[0] + HANDLE_GAP_M / 2 - 0.12
        session.go_and_wait([between, 0.0, 0.12], 12)
        session.go_and_wait([between, 0.0, 0.028], 8)
        if hidden:
            hide(session, "block0", monkeypatch)
        errors = []
        for way_m in np.cumsum([0.002, 0.004, 0.007, 0.010, 0.013, 0.016, 0.016, 0.016, 0.016]):
            estimates = session.go([between + way_m, 0.0, 0.028], 1)
            errors.append(session.error_m(estimates, "block0"))
        assert robot.referee.object_pose("drawer")[0, 3] > -0.07, "it was shut"
        assert max(errors) < 0.006


def hide(session: Session, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the camera see all but this object."""
    detector = session.tracker._detector
    numbers = [marker.number for marker in marked_objects(session.robot.task)[name].markers]
    detect = detector.detect

    def others(image: np.ndarray) -> Detections:
        found = detect(image)
        kept = ~np.isin(found.numbers, numbers)
        return Detections(found.numbers[kept], found.corners[kept])

    monkeypatch.setattr(detector, "detect", others)


def test_a_block_that_a_hand_moves_is_believed_within_a_quarter_of_a_second():
    with TwinRobot(seed=0) as robot:
        session = Session(robot)
        session.run(5)
        robot.referee.move_block(0, np.array([0.36, 0.15, 0.025]), yaw=0.6)
        assert session.error_m(session.run(6), "block0") < 0.003


def test_a_marker_of_no_object_and_a_hidden_block_are_named():
    with TwinRobot("push4", seed=0) as robot:
        session = Session(robot)
        stack = Tracker(get_task("stack"), robot.calibration, CAMERA, "ur3")
        session.tracker = stack
        session.run(12)
        with pytest.raises(RobotError, match=r"unknown marker (18|20).* in view; this task has"):
            stack.check()
    with TwinRobot("stack", seed=0) as robot:
        robot.referee.move_block(1, np.array([0.0, 1.0, 0.025]))
        session = Session(robot)
        session.run(4)
        session.tracker.check()
        assert session.tracker.missing() == ["block1 (markers 6, 7, 8, 9, 10, 11)"]


def test_a_camera_that_was_moved_is_noticed():
    with TwinRobot(camera=CameraOptions(mounting_error=1.0), seed=1) as robot:
        session = Session(robot)
        session.run(4)
        with pytest.raises(RobotError, match="pixels from where the calibration has them"):
            session.tracker.check()


def fit_at(place: list[float]) -> PoseFit:
    pose = cell.transform(np.eye(3), np.array(place))
    return PoseFit(pose, 0.1, 1e-6 * np.eye(3), 0.0)


def tool_at(time_s: float, place: list[float], opening_m: float = 0.08) -> ToolState:
    pose = cell.transform(np.eye(3), np.array(place, dtype=float))
    return ToolState(time_s, pose, np.zeros(3), np.zeros(3), opening_m, 0.0)


def on_the_table(pose: np.ndarray) -> float:
    return 0.025


FAR = cell.transform(np.eye(3), np.array([0.3, 0.0, 0.3]))


def test_one_image_that_says_something_else_is_not_believed_two_are():
    track = BlockTrack()
    for number in range(3):
        track.see(fit_at([0.3, 0.0, 0.025]), number / 30, FAR, [])
    track.see(fit_at([0.4, 0.1, 0.025]), 0.1, FAR, [])
    assert track.pose is not None and track.pose[0, 3] == pytest.approx(0.3)
    track.see(fit_at([0.3, 0.0, 0.025]), 0.133, FAR, [])
    track.see(fit_at([0.2, 0.1, 0.025]), 0.166, FAR, [])
    assert track.pose[0, 3] == pytest.approx(0.3)
    track.see(fit_at([0.2, 0.1, 0.025]), 0.2, FAR, [])
    assert track.pose[0, 3] == pytest.approx(0.2)


def test_a_block_at_rest_has_no_velocity_and_a_moving_one_has_its_own():
    track = BlockTrack()
    rng = np.random.default_rng(0)
    for number in range(6):
        track.see(fit_at([0.3 + rng.normal(0, 2e-4), 0.0, 0.025]), number / 30, FAR, [])
        assert not track.velocity.any()
    for number in range(6, 12):
        track.see(fit_at([0.3 + 0.01 * (number - 5), 0.0, 0.025]), number / 30, FAR, [])
    np.testing.assert_allclose(track.velocity, [0.3, 0.0, 0.0], atol=1e-6)


def test_a_block_out_of_sight_is_pushed_by_the_fingers_that_meet_it():
    track = BlockTrack()
    track.see(fit_at([0.3, 0.0, 0.025]), 0.0, FAR, [])
    before = tool_at(0.0, [0.25, 0.0, 0.025], 0.0)
    for step in range(1, 11):
        tool = tool_at(0.04 * step, [0.25 + 0.01 * step, 0.0, 0.025], 0.0)
        track.follow(before, tool, on_the_table)
        before = tool
    assert track.pose is not None and track.pose[0, 3] == pytest.approx(0.35 + 0.036, abs=1e-6)
    assert not track.held


def test_fingers_that_pass_a_block_or_open_do_not_hold_it():
    track = BlockTrack()
    track.see(fit_at([0.3, 0.0, 0.025]), 0.0, FAR, [])
    opening = dataclasses.replace(tool_at(0.04, [0.3, 0, 0.025], 0.05), opening_speed_m_s=0.3)
    track.follow(opening, opening, on_the_table)
    assert not track.held
    above = tool_at(0.08, [0.3, 0, 0.09], 0.05)
    track.follow(above, above, on_the_table)
    assert not track.held
    around = tool_at(0.12, [0.3, 0, 0.03], 0.05)
    track.follow(around, around, on_the_table)
    assert track.held


def moving(time_s: float, height_m: float, opening_m: float) -> ToolState:
    return dataclasses.replace(
        tool_at(time_s, [0.3, 0.0, height_m], opening_m),
        velocity=np.array([0.1, 0.0, 0.4]),
        opening_speed_m_s=0.3,
    )


def test_a_hold_begins_and_ends_between_two_readings_where_the_fingers_meet_the_block():
    track = BlockTrack()
    track.see(fit_at([0.3, 0.0, 0.025]), 0.0, FAR, [])
    closing = [moving(0.10, 0.030, 0.053), moving(0.11, 0.034, 0.049)]
    track.follow(closing[0], closing[1], on_the_table)
    # At three quarters of the way the tool was 33 mm high, and has taken the block up since.
    assert track.held and track.pose is not None
    assert track.pose[2, 3] == pytest.approx(0.025 + 0.001, abs=1e-6)
    at_rest = dataclasses.replace(moving(0.20, 0.034, 0.0494), opening_speed_m_s=0.0)
    track.follow(closing[1], at_rest, on_the_table)
    # An image from before the hold shows the block where it was taken.
    track.see(
        fit_at([0.3, 0.0, 0.025]), 0.09, tool_at(0.0, [0.3, 0.0, 0.08]).transform_tool_to_task, []
    )
    assert track.held
    track.follow(at_rest, at_rest, on_the_table)
    assert track.pose[2, 3] == pytest.approx(0.026, abs=1e-4)
    opening = moving(0.21, 0.038, 0.0514)
    track.follow(at_rest, opening, on_the_table)
    assert not track.held
    # Let go of on the way up it rises, then falls; what the camera saw before that is past.
    track.see(fit_at([0.3, 0.0, 0.030]), 0.205, FAR, [])
    later = moving(0.25, 0.054, 0.08)
    track.follow(opening, later, on_the_table)
    assert track.pose[2, 3] > 0.027
    track.follow(later, moving(0.35, 0.10, 0.08), on_the_table)
    np.testing.assert_allclose(track.pose[1:3, 3], [0.0, 0.025], atol=1e-9)
    assert 0.305 < track.pose[0, 3] < 0.312


def test_a_held_block_that_is_pressed_on_the_table_slides_up_in_the_fingers():
    track = BlockTrack()
    track.see(fit_at([0.3, 0.0, 0.025]), 0.0, FAR, [])
    tools = [tool_at(0.04 * i, [0.3, 0.0, z], 0.05) for i, z in enumerate([0.03, 0.02, 0.06])]
    for before, tool, expected in zip(tools, tools[1:], [0.025, 0.065], strict=False):
        track.follow(before, before, on_the_table)
        track.follow(before, tool, on_the_table)
        assert track.held and track.pose is not None
        assert track.pose[2, 3] == pytest.approx(expected, abs=1e-9)


def test_a_front_whose_outline_is_wrong_is_not_taken_for_a_top_that_leans_back():
    """The corners are those that were found in an image, one of them the block's own."""
    found = np.array([[243.6, 243.5], [289.0, 244.0], [295.0, 273.0], [246.3, 271.4]])
    with TwinRobot("stack", seed=0) as robot:
        tracker = Tracker(get_task("stack"), robot.calibration, CAMERA, "ur3")
        front = marked_objects(get_task("stack"))["block0"].markers[2]
        place = cell.transform(np.eye(3), np.array([0.298, -0.047, 0.025]))
        view = View(robot.calibration.cameras[CAMERA], robot.calibration.transform_base_to_task)
        right = view.project(cell.apply(place, front.corners()))
        assert np.linalg.norm(found - right, axis=1).max() > 2.0
        shown = Shown(front.number, right)
        tracker._detector = shown
        for number in range(8):
            shown.corners = right if number < 4 else found
            frame = CameraFrame(np.zeros((480, 640, 3), np.uint8), robot.now_s(), number)
            believed = tracker.update(robot.observe(), frame).objects["block0"]
            robot.wait_until(robot.now_s() + TICK_S)
            assert np.linalg.norm(believed.transform_object_to_task[:3, 3] - place[:3, 3]) < 0.01


class Shown:
    """Finds one marker, where it is told to."""

    def __init__(self, number: int, corners: np.ndarray) -> None:
        self.number, self.corners = number, corners

    def detect(self, image: np.ndarray) -> Detections:
        return Detections(np.array([self.number]), self.corners[None])


def test_an_image_is_laid_on_where_the_tool_was_then():
    arm = kinematics("ur3")
    history = ToolHistory(arm, cell.inverse(cell.transform_task_to_base()))
    for tick in range(4):
        posture = np.array(cell.HOME_RAD) + 0.02 * tick * np.eye(6)[0]
        history.add(Reading(posture, np.zeros(6), 0.08, TICK_S * tick))
    here = history.newest.transform_tool_to_task
    np.testing.assert_allclose(history.at(9.0), here)
    half = np.array(cell.HOME_RAD) + 0.03 * np.eye(6)[0]
    expected = cell.inverse(cell.transform_task_to_base()) @ arm.forward(half)
    np.testing.assert_allclose(history.at(1.5 * TICK_S)[:3, 3], expected[:3, 3], atol=1e-4)
    assert len(history.since(1.5 * TICK_S)) == 2


@pytest.mark.parametrize("name", TASKS)
def test_an_observation_of_estimates_is_laid_out_as_the_tasks(name):
    task = get_task(name)
    state, _ = task.reset(np.random.default_rng(3))
    rng = np.random.default_rng(0)
    task.qvel(state)[:] = rng.normal(0, 0.1, task.model.nv)
    qpos, qvel = task.qpos(state), task.qvel(state)
    qvel[3:5] = qvel[3]
    tool = ToolState(
        0.0, cell.transform(np.eye(3), qpos[:3]), qvel[:3], np.zeros(3), 2 * qpos[3], 2 * qvel[3]
    )
    objects = {}
    for block in range(task.blocks):
        place, speed = 5 + task.fixtures + 7 * block, 5 + task.fixtures + 6 * block
        pose = cell.transform(np.eye(3), qpos[place : place + 3])
        spin = qvel[speed + 3 : speed + 6]
        objects[f"block{block}"] = ObjectEstimate(pose, qvel[speed : speed + 3], spin, 0.0, False)
    if task.fixtures:
        with pytest.raises(RobotError, match="drawer has not been seen yet"):
            seen(task, 0.0, Estimates(tool, objects))
        pose = cell.transform(np.eye(3), np.array([-qpos[5], 0.0, 0.0]))
        objects["drawer"] = ObjectEstimate(pose, np.array([-qvel[5], 0, 0]), np.zeros(3), 0, False)
    now = seen(task, 0.0, Estimates(tool, objects))
    np.testing.assert_allclose(now.observation, task.observe(state[None])[0], atol=1e-6)
    np.testing.assert_allclose(now.achieved_goal, task.achieved_goal(state[None])[0], atol=1e-6)


def test_a_cube_on_any_face_is_taken_as_upright_and_unturned():
    import cv2

    rng = np.random.default_rng(0)
    for _ in range(100):
        yaw = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-0.7, 0.7)]))[0]
        faces = cv2.Rodrigues(np.pi / 2 * np.eye(3)[rng.integers(3)] * rng.integers(4))[0]
        sides = cv2.Rodrigues(np.pi / 2 * np.eye(3)[rng.integers(3)] * rng.integers(4))[0]
        np.testing.assert_allclose(upright(yaw @ faces @ sides), yaw, atol=1e-12)
