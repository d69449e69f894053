"""Mapping files: what they may say, and one clear line where they are wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.guess import guess_mapping, suggestion
from eisp_data.storage.mcap.mapping import Mapping, StreamMap, load_mapping
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.writer import McapWriter, camera_name

GOOD = """
instruction: Stack it.
streams:
  - {topic: /joint_states, to: observation.state, fields: [position], rule: interpolate}
  - {topic: /tf, frame: block, to: observation.achieved_goal, fields: [position]}
  - {topic: /image, to: observation.images.top, size: [48, 64]}
  - {topic: /command, to: action, low: [-1, 0], high: [1, 2.5]}
  - {topic: /subgoal, to: extra.subgoal, max_age_s: 2}
"""


def test_a_mapping_survives_being_written_and_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(GOOD)
    mapping = load_mapping(tmp_path / "a.yaml")
    assert mapping.streams[2].size == (48, 64) and mapping.streams[2].camera == "top"
    assert mapping.streams[3].high == (1.0, 2.5)
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(mapping.to_json()))
    assert load_mapping(tmp_path / "b.yaml") == mapping


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("instruction: Stack it.", "instructions: x", "unknown key 'instructions'; known: streams"),
        ("rule: interpolate", "rule: spline", "choose one of hold, nearest, interpolate"),
        ("to: action", "to: actions", "choose one of observation.state"),
        ("to: action", "to: extra.x", "no stream has to: action"),
        ("size: [48, 64]", "size: [48, 63]", "even"),
        ("size: [48, 64]", "size: 48", "is not of the right kind"),
        ("size: [48, 64]", "size: [48, 64], rule: interpolate", "cannot be interpolated"),
        ("high: [1, 2.5]", "high: [1]", "pair up"),
        ("high: [1, 2.5]", "high: [1, x]", "is not of the right kind"),
        ("frame: block", "frame: block, via: [camera]", "via needs both parent and frame"),
        ("frame: block", "frame: [block]", "is not of the right kind"),
        ("fields: [position], rule", "fields: [place], rule", "choose from"),
        ("max_age_s: 2", "max_age_s: -2", "0 or above"),
        ("max_age_s: 2", "max_age_s: .nan", "0 or above"),
        ("topic: /tf, ", "", "'topic' is missing"),
        ("streams:", "streams: 3\nx:", "unknown key 'x'"),
        ("to: extra.subgoal", "to: observation.images.top", "2 streams have to"),
        ("to: extra.subgoal", "to: extra.", "choose one of"),
        *(
            ("to: extra.subgoal", f"to: extra.{name}", f"{name!r} is a column that datasets have")
            for name in (
                "action",
                "next.reward",
                "timestamp",
                "sim.state",
                "eisp.episode",
                "observation.images.top",
                "intervention",
                "age_s.tf",
                "repeated.top",
            )
        ),
        (GOOD, "- 3", "expected keys and values"),
        (GOOD, "streams: []", "at least one stream"),
        (GOOD, "streams: [", "not YAML"),
        (GOOD, "streams: [3]", "stream 0: expected keys"),
    ],
)
def test_a_mistake_in_a_mapping_is_one_line_that_names_it(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_mapping(path)
    assert message in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_mapping_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_mapping(tmp_path / "absent.yaml")


def test_a_recording_suggests_its_own_mapping(session_file: Path) -> None:
    with McapLog(session_file) as log:
        mapping = guess_mapping(log)
    assert {(s.topic, s.frame, s.to) for s in mapping.streams} == {
        ("/events", "", "events"),
        ("/goal", "", "observation.desired_goal"),
        ("/joint_states", "", "observation.state"),
        ("/objects", "block", "observation.environment_state"),
        ("/objects", "block", "observation.achieved_goal"),
        ("/camera/top/image", "", "observation.images.top"),
        ("/command", "", "action"),
    }
    assert (mapping.task, mapping.instruction) == ("stack", "Stack it.")


def test_a_recording_that_does_not_say_enough_names_what_is_missing(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap") as writer:
        writer.vector("/mystery", [1.0])
    with (
        McapLog(tmp_path / "x.mcap") as log,
        pytest.raises(DataError, match=r"observation.state and .* and action.*/mystery"),
    ):
        guess_mapping(log)
    with McapLog(tmp_path / "x.mcap") as log:
        text = suggestion(log)
    assert "# still needed: a stream with to: action\n" in text
    assert "# not used: /mystery (eisp.Vector)\n" in text
    assert yaml.safe_load(text)["streams"] == []


def test_where_the_robot_is_counts_as_reached_only_if_nothing_else_does(tmp_path: Path) -> None:
    at_rest = ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])
    for name, things in (("both", ("block", "gripper")), ("robot", ("gripper",))):
        with McapWriter(tmp_path / f"{name}.mcap") as writer:
            writer.log("/joint_states", messages.joints(["a"], [0.0], 1), 1)
            writer.log("/poses", messages.transforms(dict.fromkeys(things, at_rest), 1), 1)
            writer.vector("/command", [0.0], 1, role="action")
        with McapLog(tmp_path / f"{name}.mcap") as log:
            streams = guess_mapping(log).streams
        assert {s.frame for s in streams if s.to == "observation.achieved_goal"} == {things[0]}
        seen = {s.frame for s in streams if s.to == "observation.environment_state"}
        assert seen == set(things)


@pytest.mark.parametrize(
    ("topic", "name"),
    [
        ("/camera/top/image", "top"),
        ("/top", "top"),
        ("/camera/color/image_raw/compressed", "camera"),
        ("/front/wrist/image", "front_wrist"),
    ],
)
def test_a_camera_is_called_by_what_is_particular_in_its_topic(topic: str, name: str) -> None:
    assert camera_name(topic) == name


def test_streams_need_a_role() -> None:
    with pytest.raises(ConfigError, match=r"no stream has to: observation\.state"):
        Mapping(streams=(StreamMap(topic="/x", to="action"),))
