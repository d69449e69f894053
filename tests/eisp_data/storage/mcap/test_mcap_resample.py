"""The rules of resampling, by worked examples and invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eisp_data.storage.mcap.chain import compose, multiply, rotate
from eisp_data.storage.mcap.collect import lost_before
from eisp_data.storage.mcap.resample import gaps, make_series, pick, resample, slerp, stands_in

MS = 1_000_000


def series_at(times_ms: list[int]) -> tuple:
    """Return a series whose value is its time in ms."""
    times = np.array(times_ms, np.int64) * MS
    return make_series(times, np.array(times_ms, float)[:, None])


@pytest.mark.parametrize(
    ("rule", "value", "age_s"),
    [("hold", 40.0, 0.06), ("nearest", 130.0, -0.03), ("interpolate", 100.0, 0.06)],
)
def test_the_worked_example_of_the_documentation(rule: str, value: float, age_s: float) -> None:
    values, ages = resample(series_at([0, 40, 130]), np.array([100 * MS]), rule, 1000 * MS)
    assert values[0, 0] == pytest.approx(value)
    assert ages[0] == pytest.approx(age_s)


def test_no_motion_is_made_up_across_a_gap() -> None:
    values, _ = resample(series_at([0, 40, 1040]), np.array([540 * MS]), "interpolate", 200 * MS)
    assert values[0, 0] == 40.0


def test_samples_out_of_order_are_sorted_and_the_last_of_equal_times_counts() -> None:
    series = make_series(np.array([5, 1, 5]), np.array([[1.0], [2.0], [3.0]]))
    assert series.times_ns.tolist() == [1, 5]
    assert series.values[:, 0].tolist() == [2.0, 3.0]


def test_a_tick_at_a_sample_takes_that_sample_under_every_rule() -> None:
    series = series_at([0, 40, 130])
    for rule in ("hold", "nearest", "interpolate"):
        values, ages = resample(series, series.times_ns, rule, 1000 * MS)
        assert values[:, 0].tolist() == [0, 40, 130] and not ages.any()


times = st.lists(st.integers(0, 2000), min_size=1, max_size=30, unique=True).map(sorted)


@given(times, st.integers(0, 2500))
def test_hold_never_looks_ahead_and_nearest_is_never_further_away(
    times_ms: list[int], tick_ms: int
) -> None:
    series, tick = series_at(times_ms), np.array([tick_ms * MS])
    held, near = pick(series, tick, "hold")[0], pick(series, tick, "nearest")[0]
    distance = np.abs(series.times_ns - tick[0])
    assert distance[near] == distance.min()
    if held < 0:
        assert tick_ms < times_ms[0]
    else:
        assert times_ms[held] == max(t for t in times_ms if t <= tick_ms)


@given(times, st.integers(0, 2500))
def test_interpolation_of_a_straight_line_is_exact_inside_and_held_after_it(
    times_ms: list[int], tick_ms: int
) -> None:
    tick = max(tick_ms, times_ms[0])
    values, _ = resample(series_at(times_ms), np.array([tick * MS]), "interpolate", 10**12)
    assert values[0, 0] == pytest.approx(min(tick, times_ms[-1]), abs=1e-9)


def about_z(angle: float) -> np.ndarray:
    """Return the quaternion, wxyz, of a turn about z."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 1), st.sampled_from([-1, 1]))
def test_orientations_turn_at_constant_speed_the_short_way(
    start: float, turn: float, part: float, sign: int
) -> None:
    # A quaternion and its negative are the same orientation: the sign must not matter.
    got = slerp(about_z(start)[None], sign * about_z(start + turn)[None], np.array([part]))[0]
    assert abs(got @ about_z(start + part * turn)) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(got) == pytest.approx(1.0)


def test_orientations_inside_a_row_of_values_are_turned_not_averaged() -> None:
    values = np.stack([np.append(1.0, about_z(0.0)), np.append(3.0, about_z(np.pi / 2))])
    series = make_series(np.array([0, 100]), values, quaternions=(1,))
    got, _ = resample(series, np.array([50]), "interpolate", 1000)
    assert got[0, 0] == 2.0
    assert abs(got[0, 1:] @ about_z(np.pi / 4)) == pytest.approx(1.0)


def test_a_camera_that_stops_leaves_a_gap_up_to_the_end() -> None:
    series = series_at([0, 50, 100, 150])
    assert gaps(series, 0, 1000 * MS, 200 * MS) == [(150 * MS, 1000 * MS)]
    assert gaps(series, 0, 200 * MS, 200 * MS) == []


angles = st.floats(-3, 3)


@given(st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.floats(-5, 5))
def test_a_composed_pose_maps_a_point_as_the_two_poses_do_in_turn(
    numbers: list[float], x: float
) -> None:
    quaternion = np.array(numbers[3:]) + np.array([2.0, 0, 0, 0])
    outer = np.append(numbers[:3], quaternion / np.linalg.norm(quaternion))[None]
    inner = np.append([x, 1.0, 2.0], about_z(x))[None]
    point = np.array([[0.3, -0.2, 0.1]])

    def apply(pose: np.ndarray, to: np.ndarray) -> np.ndarray:
        return pose[:, :3] + rotate(pose[:, 3:], to)

    np.testing.assert_allclose(
        apply(compose(outer, inner), point), apply(outer, apply(inner, point)), atol=1e-12
    )


@given(angles, angles)
def test_turns_about_one_axis_add_up(a: float, b: float) -> None:
    product = multiply(about_z(a)[None], about_z(b)[None])[0]
    np.testing.assert_allclose(product, about_z(a + b), atol=1e-12)


@pytest.mark.parametrize(
    ("rule", "wanted"),
    [("hold", [False, True, True, False]), ("nearest", [True, True, False, False])],
)
def test_rows_that_a_lost_sample_would_have_served_are_found(rule: str, wanted: list[bool]) -> None:
    series = series_at([0, 40, 120, 160])
    ticks = np.array([79, 80, 119, 120]) * MS
    for lost in ([0, 0, 0, 0], [0, 0, 1, 0]):
        assert stands_in(series, np.array(lost), ticks, rule).tolist() == wanted


def test_sequence_numbers_find_what_an_unsteady_source_lost() -> None:
    series = series_at([0, 40, 80, 100, 200])
    ticks = np.arange(0, 200, 10) * MS
    assert not stands_in(series, np.zeros(5, np.int64), ticks, "hold")[:12].any()
    found = stands_in(series, np.array([0, 0, 1, 0, 0]), ticks, "hold")
    assert np.flatnonzero(found[:12]).tolist() == [6, 7]


def test_sequence_numbers_that_do_not_count_say_nothing() -> None:
    assert lost_before(np.array([0, 1, 4, 5, 6])).tolist() == [0, 0, 2, 0, 0]
    assert not lost_before(np.zeros(5, np.int64)).any()
    assert not lost_before(np.arange(0, 50, 10)).any()
    assert not lost_before(np.array([7])).any()


@given(times, st.integers(1, 50), st.sampled_from(["hold", "nearest"]))
def test_a_row_at_a_sample_never_stands_in(times_ms: list[int], count: int, rule: str) -> None:
    series = series_at(times_ms)
    lost = np.full(len(times_ms), count)
    assert not stands_in(series, lost, series.times_ns, rule).any()
