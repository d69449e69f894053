"""Charts as SVG."""

import math
import xml.etree.ElementTree as ElementTree
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from finetune.charts import Level, Region, Series, bar_chart, line_chart, ticks

numbers = st.floats(-1e6, 1e6).map(lambda value: round(value, 4))


@given(numbers, st.floats(1e-3, 1e6), st.integers(4, 8))
def test_ticks_are_few_even_and_span_the_range(low, width, most):
    high = low + width
    found = ticks(low, high, most)
    step = found[1] - found[0]
    assert 2 <= len(found) <= most + 1
    assert found[0] <= low + 1e-6 * step and found[-1] >= high - 1e-6 * step
    assert all(math.isclose(b - a, step, rel_tol=1e-3) for a, b in pairwise(found))


@given(st.lists(st.tuples(numbers, numbers | st.just(math.nan)), max_size=20))
def test_points_stay_in_the_picture_whatever_they_are(points):
    xs, ys = [x for x, _ in points], [y for _, y in points]
    chart = line_chart("Success", "minutes", [Series("a", xs, ys, "#000")])
    svg = ElementTree.fromstring(chart)
    circles = svg.findall("circle")
    assert len(circles) == sum(map(math.isfinite, ys))
    for circle in circles:
        assert 0 <= float(circle.get("cx")) <= 460
        assert 0 <= float(circle.get("cy")) <= 270


def test_higher_values_are_higher_up():
    svg = ElementTree.fromstring(line_chart("R", "x", [Series("a", [0, 1], [-10, -5], "#000")]))
    first, second = (float(circle.get("cy")) for circle in svg.findall("circle"))
    assert second < first


def test_levels_and_regions_are_named_and_names_are_escaped():
    chart = line_chart(
        "R < 0", "x & y", [Series("a", [0, 9], [0, 1], "#000")],
        levels=[Level("a <level>", 0.5, "#111")], regions=[Region("start", 0, 4, "#222")],
    )  # fmt: skip
    words = [text.text for text in ElementTree.fromstring(chart).findall("text")]
    assert {"R < 0", "x & y", "a <level>", "start"} <= set(words)


@pytest.mark.parametrize("counts", [[0, 0], [3, 1], [100, 250]])
def test_bars_are_as_high_as_their_counts(counts):
    svg = ElementTree.fromstring(bar_chart("n", "x", ["a", "b"], [("failed", counts, "#000")]))
    heights = [float(bar.get("height")) for bar in svg.findall("rect")]
    nonzero = [count for count in counts if count]
    assert len(heights) == len(nonzero)
    for height, count in zip(heights, nonzero, strict=True):
        assert math.isclose(height / heights[0], count / nonzero[0], rel_tol=0.02)
