"""Corners come to a tenth of a pixel of where they are; poses to what their corners say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from eisp_data.robots import cell
from eisp_data.robots.aruco import MarkerDetector, refine
from eisp_data.robots.calibration import designed
from eisp_data.robots.contact import drag_drawer, push_out
from eisp_data.robots.markers import MarkedObject, dictionary, marked_objects
from eisp_data.robots.pose import Priors, View, fit_pose, fit_slide
from eisp_data.robots.robot import CameraIntrinsics
from eisp_data.tasks.registry import TASKS, get_task

FINE = 8


def picture(corners: np.ndarray, number: int = 7) -> np.ndarray:
    """Return a (120, 160, 3) image of a marker with its corners at (4, 2) px, light all around."""
    code = cv2.aruco.generateImageMarker(dictionary(), number, 240)
    code = cv2.copyMakeBorder(code, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    print_corners = np.float32([[40, 40], [280, 40], [280, 280], [40, 280]]) - 0.5
    fine = np.float32((corners + 0.5) * FINE - 0.5)
    warp = cv2.getPerspectiveTransform(print_corners, fine)
    drawn = cv2.warpPerspective(code, warp, (160 * FINE, 120 * FINE), borderValue=255)
    # Pixels see areas, as those of a camera do.
    small = cv2.resize(drawn, (160, 120), interpolation=cv2.INTER_AREA)
    return np.repeat(np.uint8(30 + 0.75 * small)[..., None], 3, axis=-1)


@pytest.fixture(params=range(6))
def corners(request: pytest.FixtureRequest) -> np.ndarray:
    rng = np.random.default_rng(request.param)
    square = 22 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    angle = rng.uniform(-0.5, 0.5)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return [80, 60] + (square * [1, 0.75]) @ turn.T + rng.uniform(-2, 2, (4, 2))


def test_corners_are_found_to_a_tenth_of_a_pixel(corners):
    found = MarkerDetector().detect(picture(corners))
    assert found.numbers.tolist() == [7]
    assert np.linalg.norm(found.corners[0] - corners, axis=1).max() < 0.12


def test_an_edge_that_is_not_there_leaves_its_corners_alone(corners):
    image = picture(corners)[..., 0]
    image[:] = 200
    np.testing.assert_array_equal(refine(image, corners[None]), corners[None])


def test_a_rim_that_is_darker_than_the_table_is_not_taken_for_the_marker(corners):
    image = picture(corners)
    # The sticker is larger than the marker by 4 mm in 42 all around, and lies in the shade.
    rim = corners.mean(axis=0) + 50 / 42 * (corners - corners.mean(axis=0))
    on = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(on, np.round(rim).astype(np.int32), 1)
    image[on == 1] = (0.65 * image[on == 1]).astype(np.uint8)
    outer = refine(image[..., 0], rim[None])[0]
    assert np.linalg.norm(outer - corners, axis=1).max() < 0.2


def test_an_empty_image_has_no_markers():
    found = MarkerDetector().detect(np.full((120, 160, 3), 90, np.uint8))
    assert len(found.numbers) == len(found.corners) == 0


@pytest.mark.parametrize("name", TASKS)
def test_no_two_markers_of_a_cell_are_the_same(name):
    numbers = [m.number for item in marked_objects(get_task(name)).values() for m in item.markers]
    assert len(numbers) == len(set(numbers)) and max(numbers) < 50


def test_a_markers_corners_go_clockwise_around_its_normal():
    for item in marked_objects(get_task("store")).values():
        for marker in item.markers:
            a, b, c, _ = marker.corners()
            clockwise = np.cross(b - a, c - b) / marker.size_m**2
            np.testing.assert_allclose(
                clockwise, -marker.transform_marker_to_object[:3, 2], atol=1e-9
            )


@pytest.fixture
def view() -> View:
    lens = CameraIntrinsics(
        640,
        480,
        np.array([[920.0, 0, 319.5], [0, 920, 239.5], [0, 0, 1]]),
        np.array([-0.06, 0.03, 5e-4, -3e-4, 0.0]),
    )
    calibration = designed("twin", "top", lens)
    return View(calibration.cameras["top"], calibration.transform_base_to_task)


def rays_of(view: View, item: MarkedObject, pose: np.ndarray, faces: list[int]) -> dict:
    """Return what the camera sees of some of an object's markers."""
    markers = [item.markers[face] for face in faces]
    return {m.number: view.undistort(view.project(cell.apply(pose, m.corners()))) for m in markers}


def block_at(place: list[float], yaw: float = 0.0, tilt: float = 0.0) -> np.ndarray:
    turn = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0] @ cv2.Rodrigues(np.array([tilt, 0, 0]))[0]
    return cell.transform(turn, np.array(place))


BLOCK = marked_objects(get_task("stack"))["block1"]
TOP, FRONT = 0, 2


@pytest.mark.parametrize("faces", [[TOP], [FRONT], [TOP, FRONT]])
@pytest.mark.parametrize(("yaw", "tilt"), [(0.0, 0.0), (0.4, 0.0), (-0.3, 0.2)])
def test_exact_corners_give_the_exact_pose(view, faces, yaw, tilt):
    pose = block_at([0.3, 0.1, 0.04], yaw, tilt)
    fit = fit_pose(view, BLOCK, rays_of(view, BLOCK, pose, faces))
    assert fit is not None and fit.error_px < 1e-3
    np.testing.assert_allclose(fit.transform_object_to_task, pose, atol=1e-4)


def test_of_the_two_poses_of_a_square_the_upright_one_is_chosen(view):
    rng = np.random.default_rng(0)
    pose = block_at([0.22, -0.12, 0.025], 0.2)
    rays = rays_of(view, BLOCK, pose, [TOP])
    for number in rays:
        rays[number] = rays[number] + rng.normal(0, 0.3 / view.focal_px, (4, 2))
    fit = fit_pose(view, BLOCK, rays, None, Priors(0.01, 0.025, 0.0007))
    assert fit is not None
    assert np.linalg.norm(fit.transform_object_to_task[:3, 3] - pose[:3, 3]) < 0.001


def test_one_wrong_corner_does_not_spoil_the_pose(view):
    pose = block_at([0.3, 0.1, 0.025])
    rays = rays_of(view, BLOCK, pose, [TOP, FRONT])
    rays[BLOCK.markers[FRONT].number][2] += 6.0 / view.focal_px
    fit = fit_pose(view, BLOCK, rays, None, Priors(0.01, 0.025, 0.0007))
    assert fit is not None and fit.error_px < 0.5
    assert np.linalg.norm(fit.transform_object_to_task[:3, 3] - pose[:3, 3]) < 0.001


def test_corners_of_no_square_are_no_pose(view):
    pose = block_at([0.3, 0.1, 0.025])
    rays = rays_of(view, BLOCK, pose, [TOP])
    rays[BLOCK.markers[TOP].number][1] += 15.0 / view.focal_px
    assert fit_pose(view, BLOCK, rays) is None
    assert fit_pose(view, BLOCK, {}) is None


def test_the_opening_of_a_drawer_follows_from_any_of_its_markers(view):
    drawer = marked_objects(get_task("store"))["drawer"]
    axis = np.array([-1.0, 0.0, 0.0])
    for face in range(len(drawer.markers)):
        pose = cell.transform(np.eye(3), 0.07 * axis)
        found = fit_slide(view, drawer, rays_of(view, drawer, pose, [face]), axis, 0.0)
        assert found is not None and abs(found[0] - 0.07) < 1e-5


def test_fingers_push_a_block_no_further_than_they_have_come_and_never_back():
    rng = np.random.default_rng(0)
    for _ in range(300):
        block = block_at([*rng.uniform(-0.04, 0.04, 2), 0.025], rng.uniform(-3, 3))
        tool = cell.transform(np.eye(3), np.array([0, 0, rng.uniform(0.0, 0.12)]))
        way = np.append(rng.uniform(-0.02, 0.02, 2), 0.0)
        moved = push_out(block, tool, rng.uniform(0, 0.08), way)[:3, 3] - block[:3, 3]
        assert np.linalg.norm(moved) <= np.linalg.norm(way) + 1e-12
        assert moved[2] == 0.0 and moved @ way >= 0


def test_closed_fingers_that_come_on_push_a_block_before_them():
    block = block_at([0.03, 0.0, 0.025])
    tool = cell.transform(np.eye(3), np.array([0.0, 0.0, 0.025]))
    moved = push_out(block, tool, 0.0, np.array([0.01, 0.0, 0.0]))
    # Half a finger and half a block.
    assert moved[0, 3] == pytest.approx(0.011 + 0.025)
    over = cell.transform(np.eye(3), np.array([0.0, 0.0, 0.09]))
    np.testing.assert_array_equal(push_out(block, over, 0.0, np.array([0.01, 0, 0])), block)


def test_fingers_that_slip_past_a_block_push_it_aside_and_do_not_take_it_along():
    block = block_at([0.0, 0.0, 0.025])
    # The left finger has come 1 mm into the block's left side.
    tool = cell.transform(np.eye(3), np.array([0.01, -0.004, 0.025]))
    moved = push_out(block, tool, 0.056, np.array([0.02, -0.004, 0.0]))
    np.testing.assert_allclose(moved[:3, 3], [0.0, -0.001, 0.025], atol=1e-12)


def test_fingers_behind_the_bar_take_the_drawer_along_and_others_do_not():
    def at(x: float, z: float = 0.03) -> np.ndarray:
        return cell.transform(np.eye(3), np.array([x, 0.0, z]))

    assert drag_drawer(0.0, at(0.34), at(0.30)) == pytest.approx(0.321 + 0.005 + 0.011 - 0.30)
    assert drag_drawer(0.1, at(0.24), at(0.29)) < 0.1
    assert drag_drawer(0.0, at(0.34, 0.07), at(0.30, 0.07)) == 0.0
    assert drag_drawer(0.0, at(0.28), at(0.25)) == 0.0
