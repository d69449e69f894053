"""ROS 2 bags, written by an independent library, become LeRobot datasets through a mapping file."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_samples import MS, PERIOD_NS, START_NS, joint_angle
from PIL import Image as PilImage
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

from eisp_data.errors import DataError
from eisp_data.storage.lerobot import read_episodes
from eisp_data.storage.mcap import decode, pixels
from eisp_data.storage.mcap.check import checks
from eisp_data.storage.mcap.convert import ConvertConfig, convert, find_inputs
from eisp_data.storage.mcap.guess import guess_mapping
from eisp_data.storage.mcap.reader import McapLog
from eisp_data.storage.mcap.summary import recordings

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types
MAPPING = """
task: stack
instruction: Stack the block.
streams:
  - {topic: /joint_states, to: observation.state, joints: [elbow, shoulder], rule: interpolate}
  - {topic: /gripper, to: observation.state, fields: [position]}
  - {topic: /tf, frame: block, parent: base, to: observation.environment_state, rule: interpolate}
  - {topic: /tf, frame: block, to: observation.achieved_goal, fields: [position]}
  - {topic: /camera/image_raw, to: observation.images.raw, rule: nearest}
  - {topic: /camera/compressed, to: observation.images.jpeg, size: [16, 24]}
  - {topic: /commands, to: action, low: [-2, 0], high: [2, 1]}
  - {topic: /episode, to: events}
"""
LATENCY_NS = 7 * MS


def header(at: int, frame: str = "base") -> Any:
    """Return a std_msgs/Header."""
    stamp = T["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
    return T["std_msgs/msg/Header"](stamp, frame)


def xyz(kind: str, *values: float) -> Any:
    """Return a geometry_msgs Point or Vector3."""
    return T[f"geometry_msgs/msg/{kind}"](*values)


def turn(w: float, z: float) -> Any:
    """Return a quaternion about z."""
    return T["geometry_msgs/msg/Quaternion"](0.0, 0.0, z, w)


def jpeg(value: int) -> bytes:
    """Return a grey JPEG of 32 by 48 pixels."""
    data = io.BytesIO()
    PilImage.fromarray(np.full((32, 48, 3), value, np.uint8)).save(data, "JPEG")
    return data.getvalue()


def instant(at: int, since: int) -> list[tuple[str, str, Any]]:
    """Return (topic, type, message) of what is published at ``at``."""
    angle = float(joint_angle(at))
    none = np.zeros(0)
    found = [
        # Two publishers on one topic, as a robot with a separate gripper has.
        ("/joint_states", "sensor_msgs/msg/JointState",
         (header(at), ["shoulder", "elbow"], np.array([angle, -angle]), none, none)),
        ("/joint_states", "sensor_msgs/msg/JointState",
         (header(at), ["finger"], np.array([0.5]), none, none)),
        ("/gripper", "sensor_msgs/msg/JointState",
         (header(at), ["finger"], np.array([0.02]), np.array([0.1]), none)),
    ]  # fmt: skip
    if since % (50 * MS) == 0:
        pose = T["geometry_msgs/msg/Transform"](
            xyz("Vector3", angle, 2.0, 3.0), turn(np.cos(angle / 2), np.sin(angle / 2))
        )
        other = T["geometry_msgs/msg/Transform"](xyz("Vector3", 9.0, 9.0, 9.0), turn(1.0, 0.0))
        stamped = T["geometry_msgs/msg/TransformStamped"]
        transforms = [
            stamped(header(at), "block", pose),
            stamped(header(at, "camera"), "marker", other),
        ]
        found.append(("/tf", "tf2_msgs/msg/TFMessage", (transforms,)))
        grey = since // (50 * MS) % 25 * 10
        colours = np.zeros((8, 10, 3), np.uint8)
        colours[:] = (grey, 100, 200)  # Blue, green, red.
        padded = np.concatenate([colours.reshape(8, 30), np.zeros((8, 2), np.uint8)], axis=1)
        found.append(
            ("/camera/image_raw", "sensor_msgs/msg/Image",
             (header(at), 8, 10, "bgr8", 0, 32, padded.reshape(-1)))
        )  # fmt: skip
        data = np.frombuffer(jpeg(grey), np.uint8)
        found.append(("/camera/compressed", "sensor_msgs/msg/CompressedImage",
                      (header(at), "jpeg", data)))  # fmt: skip
    if since >= 0 and since % PERIOD_NS == 0:
        layout = T["std_msgs/msg/MultiArrayLayout"]([], 0)
        found.append(("/commands", "std_msgs/msg/Float64MultiArray",
                      (layout, np.array([since / 1e9, 0.25]))))  # fmt: skip
    return [(topic, kind, T[kind](*fields)) for topic, kind, fields in found]


def write_bag(
    path: Path,
    episodes: int = 2,
    steps: int = 25,
    compress: bool = False,
    begun: str = "episode_start operator=bo",
    ended: str = "episode_end outcome=success",
) -> Path:
    """Write a bag: joints at 100 Hz, transforms and images at 20 Hz, commands at 25 Hz.

    Messages are recorded 7 ms after the time in their header, so the two clocks can be told apart;
    commands carry no header.
    """
    quarter = turn(np.sqrt(0.5), np.sqrt(0.5))
    place = T["geometry_msgs/msg/Transform"](xyz("Vector3", 1.0, 0.0, 0.5), quarter)
    mount = T["geometry_msgs/msg/TransformStamped"](header(0), "camera", place)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if compress:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}

    def publish(topic: str, kind: str, message: Any, at: int) -> None:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
        writer.write(connections[topic], at, STORE.serialize_cdr(message, kind))

    text = T["std_msgs/msg/String"]
    with writer:
        fixed = T["tf2_msgs/msg/TFMessage"]([mount])
        publish("/tf_static", "tf2_msgs/msg/TFMessage", fixed, START_NS - 10**9)
        for episode in range(episodes):
            start = START_NS + episode * 5_000_000_000
            publish("/episode", "std_msgs/msg/String", text(begun), start)
            for at in range(start - 50 * MS, start + steps * PERIOD_NS + 10 * MS, 10 * MS):
                for topic, kind, message in instant(at, at - start):
                    late = 0 if topic == "/commands" else LATENCY_NS
                    publish(topic, kind, message, at + late)
            end = start + steps * PERIOD_NS
            publish("/episode", "std_msgs/msg/String", text(ended), end)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of two episodes of 25 steps."""
    return write_bag(tmp_path_factory.mktemp("ros") / "bag")


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    """The mapping file of the bag."""
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    return tmp_path / "mapping.yaml"


def test_a_bag_becomes_episodes_whose_rows_are_what_was_published(
    bag: Path, mapping: Path, tmp_path: Path
) -> None:
    report = convert(ConvertConfig(inputs=(bag,), to=tmp_path / "d", mapping=mapping))
    episodes = list(read_episodes(tmp_path / "d", images=True))
    assert [len(e) for e in episodes] == [25, 25] and report.lines == []
    for number, episode in enumerate(episodes):
        ticks = START_NS + number * 5_000_000_000 + PERIOD_NS * np.arange(26)
        angle = joint_angle(ticks)
        wanted = np.stack([-angle, angle, np.full(26, 0.02)], axis=1)
        np.testing.assert_allclose(episode.observation[:, :3], wanted, atol=1e-5)
        np.testing.assert_allclose(episode.observation[:-1, 3], angle[:-1], atol=1e-5)
        half = angle[:-1] / 2
        np.testing.assert_allclose(episode.observation[:-1, 6], np.cos(half), atol=1e-5)
        np.testing.assert_allclose(episode.observation[:-1, 9], np.sin(half), atol=1e-5)
        np.testing.assert_allclose(episode.action[:, 0], np.arange(25) * 0.02, atol=1e-6)
        np.testing.assert_allclose(episode.action[:, 1], -0.5, atol=1e-6)
        assert episode.info["operator"] == "bo" and episode.done[-1]
        assert episode.images["raw"].shape == (26, 8, 10, 3)
        assert episode.images["jpeg"].shape == (26, 16, 24, 3)
        red = episode.images["raw"][..., 0].mean()
        green = episode.images["raw"][..., 1].mean()
        assert abs(red - 200) < 12 and abs(green - 100) < 12


def test_the_clock_decides_between_header_and_recording_time(
    bag: Path, mapping: Path, tmp_path: Path
) -> None:
    for clock, late in (("hardware", 0.0), ("log", LATENCY_NS / 1e9)):
        convert(ConvertConfig(inputs=(bag,), to=tmp_path / clock, mapping=mapping, clock=clock))  # type: ignore[arg-type]
        episode = next(read_episodes(tmp_path / clock))
        ticks = START_NS + PERIOD_NS * np.arange(25)
        np.testing.assert_allclose(
            episode.observation[:-1, 1], joint_angle(ticks) - late, atol=1e-5
        )


def test_a_raw_image_is_decoded_with_its_padding_and_order_of_colours(bag: Path) -> None:
    (path,) = bag.glob("*.mcap")
    with McapLog(path) as log:
        entry = next(log.messages({"/camera/image_raw"}))
        decoder = decode.Decoder()
        picture = decoder.decode(entry.channel, log.schema_of(entry.channel), entry.message.data)
    assert isinstance(picture, decode.Picture)
    assert pixels.rgb(picture).shape == (8, 10, 3)
    assert pixels.rgb(picture)[3, 9].tolist() == [200, 100, 240]


def test_a_pose_stamped_and_a_twist_are_decoded() -> None:
    from mcap.records import Channel, Schema

    at = START_NS + 5
    pose = T["geometry_msgs/msg/PoseStamped"](
        header(at), T["geometry_msgs/msg/Pose"](xyz("Point", 1.0, 2.0, 3.0), turn(0.6, 0.8))
    )
    twist = T["geometry_msgs/msg/TwistStamped"](
        header(at),
        T["geometry_msgs/msg/Twist"](xyz("Vector3", 1.0, 2.0, 3.0), xyz("Vector3", 4.0, 5.0, 6.0)),
    )
    got = []
    for number, (kind, message) in enumerate(
        (("geometry_msgs/msg/PoseStamped", pose), ("geometry_msgs/msg/TwistStamped", twist))
    ):
        definition, _ = STORE.generate_msgdef(kind, ros_version=2)
        schema = Schema(id=1, data=definition.encode(), encoding="ros2msg", name=kind)
        channel = Channel(number, "/x", "cdr", {}, 1)
        data = bytes(STORE.serialize_cdr(message, kind))
        got.append(decode.Decoder().decode(channel, schema, data))
    assert isinstance(got[0], decode.Poses) and isinstance(got[1], decode.Vector)
    assert got[0].poses[0].time_ns == at
    assert got[0].poses[0].position.tolist() == [1, 2, 3]
    assert got[0].poses[0].orientation.tolist() == pytest.approx([0.6, 0, 0, 0.8])
    assert got[1].values.tolist() == [1, 2, 3, 4, 5, 6]


def test_a_marker_seen_by_a_fixed_camera_is_placed_in_the_frame_of_the_base(
    bag: Path, tmp_path: Path
) -> None:
    (tmp_path / "m.yaml").write_text(
        "streams:\n"
        "  - {topic: /joint_states, to: observation.state}\n"
        "  - {topic: /tf, parent: base, via: [camera], frame: marker, fields: [position],\n"
        "     to: observation.achieved_goal}\n"
        "  - {topic: /commands, to: action}\n"
    )
    config = ConvertConfig(inputs=(bag,), to=tmp_path / "d", mapping=tmp_path / "m.yaml")
    convert(config)
    episode = next(read_episodes(tmp_path / "d"))
    # (9, 9, 9) before a camera at (1, 0, 0.5) that is turned by 90 degrees about z.
    np.testing.assert_allclose(episode.achieved_goal, [[1 - 9.0, 9.0, 9.5]] * 151, atol=1e-5)


def test_a_compressed_bag_converts_to_the_same_episodes(
    bag: Path, mapping: Path, tmp_path: Path
) -> None:
    packed = write_bag(tmp_path / "packed", compress=True)
    convert(ConvertConfig(inputs=(packed,), to=tmp_path / "a", mapping=mapping))
    convert(ConvertConfig(inputs=(bag,), to=tmp_path / "b", mapping=mapping))
    for a, b in zip(read_episodes(tmp_path / "a"), read_episodes(tmp_path / "b"), strict=True):
        assert np.array_equal(a.observation, b.observation)
        assert np.array_equal(a.action, b.action)


def test_events_in_other_words_do_not_make_one_episode_of_all(
    mapping: Path, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path / "bag", begun="start", ended="stop success")
    with pytest.raises(DataError, match=r"events say 'start', 'stop', .* known are episode_start"):
        convert(ConvertConfig(inputs=(bag,), to=tmp_path / "d", mapping=mapping))
    (path,) = bag.glob("*.mcap")
    (check,) = [check for check in checks(path) if check.name == "episodes"]
    assert not check.passed and "'start'" in check.detail


def test_an_outcome_that_is_not_known_is_told(mapping: Path, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", ended="episode_end outcome=fine")
    report = convert(ConvertConfig(inputs=(bag,), to=tmp_path / "d", mapping=mapping))
    assert report.episodes == 2
    (line,) = [line for line in report.lines if "outcome" in line]
    assert "'outcome=fine'" in line and "outcome=success|failure|timeout|discard" in line
    (path,) = bag.glob("*.mcap")
    (check,) = [check for check in checks(path) if check.name == "episodes"]
    assert check.passed and check.warning


def test_a_bag_that_is_no_mcap_says_how_to_make_one(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/bag_0.db3").write_bytes(b"SQLite format 3")
    for look in (recordings, lambda path: find_inputs((path,))):
        with pytest.raises(DataError, match="a ROS 2 bag in sqlite3; ros2 bag convert makes an"):
            look(tmp_path / "bag")


def test_every_check_passes_on_a_good_bag_but_that_its_joints_move(bag: Path) -> None:
    (path,) = bag.glob("*.mcap")
    results = checks(path)
    assert all(check.passed for check in results)
    # The gripper of this bag never moves, and between its episodes it is silent.
    assert {check.name for check in results if check.warning} == {"not stuck", "no gaps"}


def test_a_bag_with_usual_names_suggests_its_own_mapping(bag: Path) -> None:
    (path,) = bag.glob("*.mcap")
    with McapLog(path) as log:
        found = {(s.topic, s.frame, s.to) for s in guess_mapping(log).streams}
    assert found == {
        ("/joint_states", "", "observation.state"),
        ("/gripper", "", "observation.state"),
        ("/commands", "", "action"),
        ("/episode", "", "events"),
        ("/camera/compressed", "", "observation.images.camera"),
        *(("/tf", f, f"observation.{to}") for f in ("block", "marker") for to in
          ("environment_state", "achieved_goal")),
    }  # fmt: skip


@pytest.mark.parametrize("cut", [0, 3, 20, 60])
def test_a_message_that_is_cut_short_is_one_line(bag: Path, cut: int) -> None:
    (path,) = bag.glob("*.mcap")
    with McapLog(path) as log:
        for topic, channel in log.topics.items():
            data = next(log.messages({topic})).message.data[:cut]
            try:
                decode.Decoder().decode(channel, log.schema_of(channel), data)
            except DataError as error:
                assert topic in str(error) and "\n" not in str(error)


def test_messages_with_flipped_bits_decode_or_are_refused_in_one_line(bag: Path) -> None:
    (path,) = bag.glob("*.mcap")
    rng = np.random.default_rng(5)
    refused = 0
    with McapLog(path) as log:
        for topic, channel in log.topics.items():
            original = next(log.messages({topic})).message.data
            for _ in range(100):
                data = bytearray(original)
                for place in rng.integers(len(data), size=4):
                    data[place] ^= 1 << int(rng.integers(8))
                try:
                    got = decode.Decoder().decode(channel, log.schema_of(channel), bytes(data))
                    if isinstance(got, decode.Picture):
                        pixels.rgb(got)
                except DataError as error:
                    refused += 1
                    assert "\n" not in str(error)
    assert refused > 50


def test_a_definition_that_is_damaged_is_refused_in_one_line(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path,) = bag.glob("*.mcap")
    rng = np.random.default_rng(6)
    with McapLog(path) as log:
        for topic, channel in log.topics.items():
            schema = log.schema_of(channel)
            assert schema is not None
            message = next(log.messages({topic})).message
            for _ in range(30):
                text = bytearray(schema.data)
                for place in rng.integers(len(text), size=3):
                    text[place] ^= 1 << int(rng.integers(8))
                bad = replace(schema, data=bytes(text))
                try:
                    decode.Decoder().decode(channel, bad, message.data)
                except DataError as error:
                    assert "\n" not in str(error)
    assert capsys.readouterr() == ("", "")
