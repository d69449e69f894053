"""A calibration file says what was found, or what is wrong with it; what is found is the truth."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from eisp_data.cli import calibrate as command
from eisp_data.errors import ConfigError, RobotError
from eisp_data.robots import cell
from eisp_data.robots.arms import get_arm
from eisp_data.robots.calibration import Calibration, designed, load_calibration
from eisp_data.robots.charuco import BoardView, board
from eisp_data.robots.hand_eye import solve_hand_eye
from eisp_data.robots.registry import make_robot
from eisp_data.robots.robot import CameraIntrinsics
from eisp_data.robots.robot_config import make_configured
from eisp_data.robots.session_cell import CellConfig, _calibration

LENS = CameraIntrinsics(
    640,
    480,
    np.array([[915.0, 0, 322], [0, 918, 236], [0, 0, 1]]),
    np.array([-0.06, 0.03, 5e-4, -3e-4, 0.0]),
)


SLOPE = 0.5**0.5
HELD = cell.transform(
    np.array([[0, SLOPE, -SLOPE], [1, 0, 0], [0, -SLOPE, -SLOPE]]), np.array([0.005, -0.08, 0.165])
)
"""The board in the hand; it faces forwards and up."""


@pytest.fixture
def calibration() -> Calibration:
    return designed("twin", "top", LENS)


def test_a_file_says_what_was_saved(calibration, tmp_path):
    calibration.save(tmp_path / "cell.yaml")
    read = load_calibration(tmp_path / "cell.yaml")
    assert read.robot == "twin" and list(read.cameras) == ["top"]
    camera, same = calibration.cameras["top"], read.cameras["top"]
    np.testing.assert_allclose(same.intrinsics.matrix, camera.intrinsics.matrix, atol=1e-8)
    np.testing.assert_allclose(same.intrinsics.distortion, camera.intrinsics.distortion, atol=1e-8)
    np.testing.assert_allclose(
        same.transform_camera_to_base, camera.transform_camera_to_base, atol=1e-8
    )
    np.testing.assert_allclose(
        read.transform_task_to_base, calibration.transform_task_to_base, atol=1e-8
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("robot: twin", "robot: [", "cannot read the configuration"),
        ("robot: twin", "robot: 3", "robot: expected a text; got 3"),
        ("width: 640", "wide: 640", "unknown key 'cameras.top.wide'"),
        ("- - 915.0", "- - .nan", "cameras.top.matrix: expected 3x3 finite numbers"),
        ("- - 915.0\n      - 0.0\n", "- - 915.0\n", "expected 3x3 finite numbers"),
        ("transform_task_to_base:\n- - 1.0", "transform_task_to_base:\n- - 2.0", "a rotation and"),
    ],
)
def test_a_garbled_file_is_one_line_that_names_the_place(calibration, tmp_path, old, new, said):
    path = tmp_path / "cell.yaml"
    calibration.save(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=said) as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_file_for_another_tool_than_the_arms_is_refused(calibration, tmp_path):
    path = tmp_path / "cell.yaml"
    calibration.save(path)
    robot = make_robot("twin")
    load_calibration(path).check(robot)
    path.write_text(path.read_text().replace("- 0.165\n", "- 0.195\n", 1))
    said = r"transform_tool_to_flange is .*0\.195.*, but that of ur3 is .*0\.165"
    with pytest.raises(ConfigError, match=said):
        load_calibration(path).check(robot)


@pytest.mark.parametrize(
    ("name", "side", "arm"),
    [
        pytest.param(
            "ur3",
            None,
            "ur3",
            marks=pytest.mark.skipif(not find_spec("rtde_control"), reason="no ur-rtde here"),
        ),
        ("tiago", "left", "tiago_left"),
        ("tiago", "right", "tiago_right"),
        ("twin", None, "ur3"),
    ],
)
def test_without_a_file_and_a_task_everything_is_at_the_arms_usual_place(name, side, arm):
    config = CellConfig(robot=name, host="127.0.0.1", side=side)
    robot = make_configured(config, {})
    found = _calibration(config, robot)
    np.testing.assert_array_equal(found.transform_task_to_base, get_arm(arm).transform_task_to_base)
    np.testing.assert_array_equal(
        found.transform_tool_to_flange, get_arm(arm).transform_tool_to_tip
    )
    assert found.robot == robot.name


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        load_calibration(tmp_path / "none.yaml")


def hand_eye_views(count: int, noise_px: float) -> tuple[list[BoardView], list[np.ndarray]]:
    """Return what the designed camera sees of a board in the hand, and the tool's poses."""
    import cv2

    rng = np.random.default_rng(0)
    camera = cell.inverse(cell.transform_task_to_base() @ cell.transform_camera_to_task())
    points = board().getChessboardCorners().astype(float)
    views, tools = [], []
    for _ in range(count):
        turn = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
        place = rng.uniform([0.22, -0.1, 0.1], [0.36, 0.1, 0.2]) - cell.BASE_IN_TASK_M
        tool = cell.transform(turn, place)
        seen = cell.apply(camera @ tool @ HELD, points)
        pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)[0]
        noise = rng.normal(0, noise_px, (len(points), 2))
        views.append(BoardView(points, pixels[:, 0] + noise))
        tools.append(tool)
    return views, tools


@pytest.mark.parametrize(("noise_px", "within_m"), [(0.0, 1e-5), (0.1, 1.5e-3)])
def test_lens_camera_and_board_are_found_from_images_of_the_board(noise_px, within_m):
    views, tools = hand_eye_views(30, noise_px)
    found = solve_hand_eye(views, tools, 640, 480)
    true = cell.transform_task_to_base() @ cell.transform_camera_to_task()
    assert np.linalg.norm(found.transform_camera_to_base[:3, 3] - true[:3, 3]) < 2 * within_m
    assert np.linalg.norm(found.transform_board_to_tool[:3, 3] - HELD[:3, 3]) < within_m
    assert found.error_px == pytest.approx(2**0.5 * noise_px, rel=0.15, abs=0.01)
    assert abs(found.intrinsics.matrix[0, 0] / LENS.matrix[0, 0] - 1) < 0.003


def test_a_board_that_slipped_in_the_hand_is_noticed():
    views, tools = hand_eye_views(30, 0.1)
    for tool in tools[15:]:
        tool[:3, 3] += [0.0, 0.02, 0.0]
    with pytest.raises(RobotError, match="the images fit no camera"):
        solve_hand_eye(views, tools, 640, 480)


def test_too_few_images_are_too_few():
    with pytest.raises(RobotError, match="saw the board in 5 images only; 12 are needed"):
        solve_hand_eye(*hand_eye_views(5, 0.0), 640, 480)


def test_the_command_finds_where_the_twins_camera_really_is(tmp_path, capsys):
    path = tmp_path / "cell.yaml"
    command.calibrate(command.CalibrateConfig(output=path, views=14, seed=1))
    from eisp_data.robots.twin.camera import CameraOptions
    from eisp_data.robots.twin.robot import TwinRobot

    robot = TwinRobot(seed=1, camera=CameraOptions(mounting_error=1.0))
    read = load_calibration(path)
    read.check(robot)
    true = cell.transform_task_to_base() @ robot.referee.camera.transform_camera_to_task
    point = cell.inverse(true) @ [*(np.array([0.31, 0.0, 0.03]) - cell.BASE_IN_TASK_M), 1.0]
    # What counts is where a point of the workspace is taken to be.
    found = read.transform_base_to_task @ read.cameras["top"].transform_camera_to_base @ point
    assert np.linalg.norm(found[:3] - [0.31, 0.0, 0.03]) < 0.003
    off = robot.calibration.cameras["top"].transform_camera_to_base @ point
    assert np.linalg.norm(off[:3] + cell.BASE_IN_TASK_M - [0.31, 0.0, 0.03]) > 0.004
    assert "reprojection error" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"robot": "ur3"}, "of robot 'twin', not of 'ur3'"),
        ({"cameras": {"side": LENS}}, "has no camera 'side'; it has top"),
        (
            {"cameras": {"top": CameraIntrinsics(1280, 720, LENS.matrix)}},
            "for 640x480 pixels, but the camera gives 1280x720",
        ),
    ],
)
def test_the_calibration_of_another_cell_is_refused(calibration, change, said):
    class Other:
        name, arm = change.get("robot", "twin"), "ur3"
        cameras = change.get("cameras", {"top": LENS})

    with pytest.raises(ConfigError, match=said):
        calibration.check(Other())  # type: ignore[arg-type]


def test_a_bad_command_line_is_one_line(tmp_path):
    (tmp_path / "mine.yaml").write_text("mine")
    for config, said in (
        (command.CalibrateConfig(output=tmp_path), "--output: cannot write .*Is a directory"),
        (command.CalibrateConfig(output=tmp_path / "mine.yaml"), "exists already"),
        (command.CalibrateConfig(output=tmp_path / "cell.yaml", seed=2**40), "--seed must be"),
        (
            command.CalibrateConfig(output=tmp_path / "cell.yaml", views=0),
            "--views must be at least 1",
        ),
        (command.CalibrateConfig(output=tmp_path / "cell.yaml", robot="ur3"), "missing --host"),
        (
            command.CalibrateConfig(output=tmp_path / "cell.yaml", camera="side"),
            "choose one of top",
        ),
    ):
        with pytest.raises(ConfigError, match=said):
            command.calibrate(config)
