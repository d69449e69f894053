"""Configurations as plain values and YAML."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from eisp_data.config import from_plain, load_yaml, save_yaml, to_plain
from eisp_data.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    size: int = 1
    rate: float = 0.5
    layers: tuple[int, ...] = (256, 256)
    pair: tuple[int, str] = (1, "a")


@dataclass(frozen=True)
class Outer:
    root: Path
    inner: Inner = field(default_factory=Inner)
    device: Literal["auto", "cpu"] = "auto"
    limit: int | None = None
    flag: bool = False
    weights: dict[str, float] = field(default_factory=dict)


inners = st.builds(
    Inner,
    size=st.integers(),
    rate=st.floats(allow_nan=False),
    layers=st.lists(st.integers()).map(tuple),
    pair=st.tuples(st.integers(), st.text()),
)
outers = st.builds(
    Outer,
    root=st.text(st.characters(codec="ascii", categories=["L"]), min_size=1).map(Path),
    inner=inners,
    device=st.sampled_from(["auto", "cpu"]),
    limit=st.none() | st.integers(),
    flag=st.booleans(),
    weights=st.dictionaries(st.text(), st.floats(allow_nan=False)),
)


@settings(max_examples=40, deadline=None)
@given(outers)
def test_a_configuration_comes_back_from_yaml_as_it_was(config):
    assert from_plain(Outer, yaml.safe_load(yaml.safe_dump(to_plain(config)))) == config


def test_a_file_gives_back_what_was_saved(tmp_path):
    config = Outer(Path("data/stack"), Inner(layers=(512,) * 4), limit=3)
    save_yaml(config, tmp_path / "config.yaml")
    assert load_yaml(Outer, tmp_path / "config.yaml") == config


@pytest.mark.parametrize(
    ("plain", "message"),
    [
        ({"root": "x", "rot": 1}, "unknown key 'rot'; choose one of root, inner, device"),
        ({"root": "x", "inner": {"sise": 1}}, "unknown key 'inner.sise'; choose one of size, rate"),
        ({}, "missing key 'root'"),
        ({"root": "x", "inner": {"size": "big"}}, "inner.size: expected a whole number; got 'big'"),
        ({"root": "x", "inner": {"size": True}}, "inner.size: expected a whole number; got True"),
        ({"root": "x", "flag": 1}, "flag: expected true or false; got 1"),
        ({"root": "x", "device": "tpu"}, "device: expected one of auto, cpu; got 'tpu'"),
        ({"root": "x", "inner": {"rate": "fast"}}, "inner.rate: expected a number; got 'fast'"),
        ({"root": "x", "inner": {"layers": 256}}, "inner.layers: expected a list; got 256"),
        ({"root": "x", "inner": {"pair": [1]}}, "inner.pair: expected a list of 2"),
        ({"root": "x", "inner": []}, "inner: expected keys and values"),
        ([], "configuration: expected keys and values"),
    ],
)
def test_a_mistake_is_named_with_the_choices(plain, message):
    with pytest.raises(ConfigError) as caught:
        from_plain(Outer, plain)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_exponent_without_a_point_is_a_number_although_yaml_says_otherwise(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("root: x\ninner: {rate: 1e-3}")
    assert load_yaml(Outer, path).inner.rate == 0.001


@pytest.mark.parametrize("text", ["root: [", "root: x\n\tinner: 1", "\x00"])
def test_damaged_yaml_is_told_in_one_line_that_names_the_file(tmp_path, text):
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_yaml(Outer, path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_required_keys_may_be_left_for_later():
    later = object()
    assert from_plain(Outer, {"limit": 2}, absent=later).root is later
