"""Write a ROS 2 bag as a robot would: simulated demonstrations of stacking blocks.

    python docs/example_bag.py my_bag                  # 60 episodes; then see the README
    python docs/example_bag.py my_bag --episodes 5 --no-camera

It stands in for a recording of ``ros2 bag record`` and needs no ROS: the bag is written by
``rosbags``. The robot's fingers are joints, its gripper is a PoseStamped, the blocks are
transforms, the camera sends JPEGs, and each command is what was really sent.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from tqdm import tqdm

from eisp_data.cli.run import run
from eisp_data.collect import collect
from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
from eisp_data.sim.pixels import Pixels
from eisp_data.tasks.base import GRIPPER_DIM, OBJECT_DIM
from eisp_data.tasks.registry import get_task

TASK = "stack"
PERIOD_NS = 40_000_000
PAUSE_NS = 2_000_000_000
START_NS = 1_700_000_000_000_000_000
LATENCY_NS = 4_000_000
"""How long after the time in its header a message is recorded."""
CAMERA_PIXELS = 96
FALLEN_M = -0.05
"""A block below this height has fallen off the table, and the simulator has no floor."""
STORE = get_typestore(Stores.ROS2_HUMBLE)
Message = tuple[str, str, Any]
"""Topic, type and message."""


@dataclass(frozen=True)
class Options:
    """What to record."""

    bag: tyro.conf.Positional[Path]
    """Folder of the bag to make."""
    episodes: int = 60
    """How many demonstrations."""
    seed: int = 1_000_000
    """Seed of the first."""
    camera: bool = True
    """Record a camera too; it needs OpenGL."""


def main() -> None:
    """Write the bag."""
    run(write, prog="example_bag.py")


def write(options: tyro.conf.OmitArgPrefixes[Options]) -> None:
    """Write a ROS 2 bag of simulated demonstrations."""
    if options.bag.exists():
        raise DataError(f"{options.bag}: exists already; choose another folder")
    task = get_task(TASK)
    seeds = range(options.seed, options.seed + options.episodes)
    episodes = collect(task, SCRIPTS[TASK], DEMONSTRATOR[TASK], seeds)
    camera = Pixels(task, "front", CAMERA_PIXELS, CAMERA_PIXELS) if options.camera else None
    writer = Writer(options.bag, version=9, storage_plugin=StoragePlugin.MCAP)
    connections: dict[str, Any] = {}
    start = START_NS
    with writer:
        for episode in tqdm(episodes, "episodes", options.episodes):
            for at, (topic, kind, message) in messages(episode, start, camera):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
                writer.write(
                    connections[topic], at + LATENCY_NS, STORE.serialize_cdr(message, kind)
                )
            start += len(episode) * PERIOD_NS + PAUSE_NS


def messages(episode: Episode, start: int, camera: Pixels | None) -> Iterator[tuple[int, Message]]:
    """Yield hardware time and message of all that happens in an episode, in order."""
    yield start, text("episode_start operator=simulated")
    yield start, numbers("/goal", episode.desired_goal)
    for step in range(len(episode) + 1):
        at = start + step * PERIOD_NS
        observation = episode.observation[step]
        yield at, fingers(observation, at)
        yield at, gripper(observation, at)
        yield at, blocks(observation, at)
        if camera is not None:
            yield at, picture(camera.draw(episode.sim_state[step : step + 1])[0], at)
        if step < len(episode):
            yield at, numbers("/command", episode.action[step])
    yield at, text(f"episode_end outcome={outcome(episode)}")


def outcome(episode: Episode) -> str:
    """Return what whoever watches says at the end; ``discard`` keeps it out of the dataset."""
    heights = episode.achieved_goal.reshape(-1, 3)[:, 2]
    if heights.min() < FALLEN_M:
        return "discard"
    return "success" if episode.success[-1] else "failure"


def make(kind: str, *fields: Any) -> Any:
    """Return a message of a type, its fields in order."""
    return STORE.types[kind](*fields)


def header(at: int, frame: str) -> Any:
    """Return a std_msgs/Header."""
    return make(
        "std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(at, 10**9)), frame
    )


def text(said: str) -> Message:
    """Return an event: its kind, and details as ``key=value``."""
    return "/episode", "std_msgs/msg/String", make("std_msgs/msg/String", said)


def numbers(topic: str, values: np.ndarray) -> Message:
    """Return named-by-place numbers; such a message has no time of its own."""
    layout = make("std_msgs/msg/MultiArrayLayout", [], 0)
    kind = "std_msgs/msg/Float64MultiArray"
    return topic, kind, make(kind, layout, values.astype(np.float64))


def fingers(observation: np.ndarray, at: int) -> Message:
    """Return both fingers as joints, m and m/s."""
    position, speed = observation[3:5].astype(np.float64), observation[8:10].astype(np.float64)
    kind = "sensor_msgs/msg/JointState"
    names = ["left_finger", "right_finger"]
    return "/joint_states", kind, make(kind, header(at, ""), names, position, speed, np.zeros(0))


def gripper(observation: np.ndarray, at: int) -> Message:
    """Return the pose of the gripper, which always points down."""
    place = make("geometry_msgs/msg/Point", *map(float, observation[:3]))
    down = make("geometry_msgs/msg/Quaternion", 1.0, 0.0, 0.0, 0.0)
    kind = "geometry_msgs/msg/PoseStamped"
    pose = make("geometry_msgs/msg/Pose", place, down)
    return "/gripper_pose", kind, make(kind, header(at, "base"), pose)


def blocks(observation: np.ndarray, at: int) -> Message:
    """Return where the blocks are in the frame of the base."""
    found = []
    for number, part in enumerate(observation[GRIPPER_DIM:].reshape(-1, OBJECT_DIM)):
        place = make("geometry_msgs/msg/Vector3", *map(float, part[:3]))
        yaw = float(part[8]) / 2
        turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(yaw), np.cos(yaw))
        pose = make("geometry_msgs/msg/Transform", place, turn)
        kind = "geometry_msgs/msg/TransformStamped"
        found.append(make(kind, header(at, "base"), f"block_{number}", pose))
    return "/tf", "tf2_msgs/msg/TFMessage", make("tf2_msgs/msg/TFMessage", found)


def picture(pixels: np.ndarray, at: int) -> Message:
    """Return a camera image as a JPEG."""
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "JPEG", quality=90)
    kind = "sensor_msgs/msg/CompressedImage"
    jpeg = np.frombuffer(data.getvalue(), np.uint8)
    return "/camera/front/compressed", kind, make(kind, header(at, "front"), "jpeg", jpeg)


if __name__ == "__main__":
    main()
