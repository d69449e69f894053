"""How fast data is written and sampled, against LeRobot's own path, in one run.

    python benchmarks/data.py                 # prints a table of rates and their ratios

Each pair is measured one right after the other on the same episodes, and the best of a few
repetitions counts on both sides. Every written dataset is opened again, and its rows and video
frames are counted.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import numpy as np
import tyro

from eisp_data.episode import Episode
from eisp_data.storage.cache import DatasetArrays, load_arrays
from eisp_data.storage.lerobot import DatasetSpec, DatasetWriter
from eisp_data.storage.schema import SIDECAR_COLUMN, features
from eisp_data.storage.video import feature_info


@dataclasses.dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    steps: int = 300
    """Frames of an episode."""
    episodes: int = 32
    """Episodes in one batch of ours."""
    peer_episodes: int = 4
    """Episodes given to LeRobot's writer, which needs that much longer for each."""
    repeats: int = 3
    """Repetitions; the fastest counts."""
    batch: int = 1024
    """Samples in a training batch."""


def episode(spec: DatasetSpec, steps: int, seed: int) -> Episode:
    """Return an episode with a plausible, compressible course: smooth noise."""
    rng = np.random.default_rng(seed)

    def walk(*shape: int) -> np.ndarray:
        return np.cumsum(rng.normal(scale=0.01, size=shape), axis=0)

    images = {}
    for camera, (height, width) in spec.cameras.items():
        ramp = np.linspace(0, 200, height * width * 3).reshape(height, width, 3)
        texture = rng.integers(0, 20, ramp.shape)
        images[camera] = np.stack(
            [np.roll(ramp + texture, t, axis=1).astype(np.uint8) for t in range(steps + 1)]
        )
    return Episode(
        observation=walk(steps + 1, spec.observation_dim).astype(np.float32),
        achieved_goal=walk(steps + 1, spec.goal_dim).astype(np.float32),
        desired_goal=rng.normal(size=spec.goal_dim).astype(np.float32),
        action=rng.uniform(-1, 1, (steps, spec.action_dim)).astype(np.float32),
        reward=-np.ones(steps, np.float32),
        done=np.zeros(steps, bool),
        truncated=np.arange(steps) == steps - 1,
        success=np.zeros(steps + 1, bool),
        sim_state=walk(steps + 1, spec.sim_state_dim),
        seed=seed,
        images=images,
    )


def spec_of(cameras: dict[str, tuple[int, int]]) -> DatasetSpec:
    """Return a spec of the size of Stack: 55 numbers of observation, 9 of goal, 4 of action."""
    return DatasetSpec(
        task="stack",
        instruction="Stack the blocks.",
        observation_dim=55,
        goal_dim=9,
        action_dim=4,
        sim_state_dim=67,
        cameras=cameras,
    )


def best(measure: Callable[[Path], float], repeats: int) -> float:
    """Return the highest rate of some repetitions, each in a folder of its own."""
    rates = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            rates.append(measure(Path(folder)))
    return max(rates)


def write_ours(folder: Path, spec: DatasetSpec, episodes: list[Episode]) -> float:
    """Return frames/s of our writer, closing included."""
    frames = sum(map(len, episodes))
    begin = time.perf_counter()
    with DatasetWriter(folder / "ours", spec, {}) as writer:
        writer.write(episodes)
    rate = frames / (time.perf_counter() - begin)
    check_frames(folder / "ours", spec, frames)
    return rate


def write_peer(
    folder: Path, spec: DatasetSpec, episodes: list[Episode], our_codec: bool = False
) -> float:
    """Return frames/s of ``add_frame`` and ``save_episode``, streaming its video.

    Its codec is AV1 unless ``our_codec`` gives it the H.264 settings of ours.
    """
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    table = features(spec, partial(feature_info, spec.fps))
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        del table[name]
    ours: dict[str, Any] = {}
    for feature in table.values():
        feature["shape"] = tuple(feature["shape"])
        ours = feature.pop("info", ours)
    dataset = LeRobotDataset.create(
        "bench/peer",
        spec.fps,
        table,
        root=folder / "peer",
        use_videos=bool(spec.cameras),
        streaming_encoding=bool(spec.cameras),
        rgb_encoder=RGBEncoderConfig.from_video_info(ours) if our_codec else None,
        # Its queue drops frames when full; one as long as the episode makes it keep them all.
        encoder_queue_maxsize=len(episodes[0]) + 1,
    )
    rows = [frames_of(spec, item) for item in episodes]
    begin = time.perf_counter()
    for frames in rows:
        for frame in frames:
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    rate = sum(map(len, episodes)) / (time.perf_counter() - begin)
    check_frames(folder / "peer", spec, sum(map(len, episodes)))
    return rate


def frames_of(spec: DatasetSpec, item: Episode) -> list[dict[str, Any]]:
    """Return an episode as the frames that ``add_frame`` takes, the same columns as ours."""
    own = spec.proprio_dim
    return [
        {
            "observation.state": item.observation[t, :own],
            "observation.environment_state": item.observation[t, own:],
            "observation.achieved_goal": item.achieved_goal[t],
            "observation.desired_goal": item.desired_goal,
            "action": item.action[t],
            "next.reward": item.reward[t : t + 1],
            "next.done": item.done[t : t + 1],
            "next.truncated": item.truncated[t : t + 1],
            "next.success": item.success[t + 1 : t + 2],
            "sim.state": item.sim_state[t],
            SIDECAR_COLUMN: "",
            **{f"observation.images.{c}": f[t] for c, f in item.images.items()},
            "task": spec.instruction,
        }
        for t in range(len(item))
    ]


def check_frames(root: Path, spec: DatasetSpec, frames: int) -> None:
    """Fail unless a dataset has so many rows, and its videos as many frames."""
    import av
    import pyarrow.parquet as pq

    rows = sum(pq.read_metadata(path).num_rows for path in root.glob("data/*/*.parquet"))
    assert rows == frames, f"{root}: {rows} rows of {frames}"
    for camera in spec.cameras:
        count = 0
        for path in root.glob(f"videos/observation.images.{camera}/*/*.mp4"):
            with av.open(str(path)) as container:
                count += sum(1 for _ in container.decode(video=0))
        assert count == frames, f"{root}: {count} video frames of {frames}"


def sample_ours(arrays: DatasetArrays, batch: int, seconds: float = 1.0) -> float:
    """Return samples/s of transitions with goals relabelled in hindsight.

    A sample is (observation, action, next observation, goal, reward): the goal is what a later
    observation of the same episode achieved, the reward Eq. (1) of the paper with it.
    """
    rng = np.random.default_rng(0)
    starts, counts = arrays.episode_start, np.diff(arrays.episode_start) - 1
    # Every row that has an action, and the last row of its episode.
    rows = np.concatenate([np.arange(s, s + n) for s, n in zip(starts[:-1], counts, strict=True)])
    last = np.repeat(starts[1:] - 1, counts)
    drawn, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        pick = rng.integers(len(rows), size=batch)
        row = rows[pick]
        future = rng.integers(row + 1, last[pick] + 1)
        goal = np.take(arrays.achieved_goal, future, axis=0)
        reached = np.take(arrays.achieved_goal, row + 1, axis=0)
        _ = (
            np.take(arrays.observation, row, axis=0),
            np.take(arrays.action, row, axis=0),
            np.take(arrays.observation, row + 1, axis=0),
            -(np.linalg.norm(reached - goal, axis=1) > 0.05).astype(np.float32),
        )
        drawn += batch
    return drawn / (time.perf_counter() - begin)


def sample_peer(root: Path, batch: int, batches: int = 4) -> float:
    """Return samples/s of a DataLoader over LeRobotDataset, in this process, no relabelling."""
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loader = torch.utils.data.DataLoader(
        LeRobotDataset("bench/ours", root=root), batch_size=batch, shuffle=True
    )
    iterator = iter(loader)
    next(iterator)
    begin = time.perf_counter()
    for _ in range(batches):
        next(iterator)
    return batches * batch / (time.perf_counter() - begin)


def main(options: Options) -> None:
    """Measure and print the table."""
    rows: list[tuple[str, float, float]] = []
    sizes: list[tuple[str, dict[str, tuple[int, int]], int]] = [
        ("write, state only", {}, options.episodes),
        ("write, video 48x48", {"top": (48, 48)}, options.peer_episodes),
        ("write, video 480x640", {"top": (480, 640)}, 1),
    ]
    for name, cameras, count in sizes:
        spec = spec_of(cameras)
        episodes = [episode(spec, options.steps, seed) for seed in range(count)]
        peers = episodes[: options.peer_episodes]
        ours = best(lambda f, s=spec, e=episodes: write_ours(f, s, e), options.repeats)
        for codec, same in (("", False), (", same codec", True))[: 2 if cameras else 1]:
            theirs = best(
                lambda f, s=spec, e=peers, c=same: write_peer(f, s, e, c), options.repeats
            )
            rows.append((f"{name}{codec}, frames/s", theirs, ours))
    spec = spec_of({})
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "ours"
        with DatasetWriter(root, spec, {}) as writer:
            writer.write([episode(spec, options.steps, seed) for seed in range(options.episodes)])
        theirs = sample_peer(root, options.batch)
        ours = sample_ours(load_arrays(root), options.batch)
        rows.append((f"sample, batch {options.batch}, samples/s", theirs, ours))
    print(f"{'':40}{'LeRobot':>12}{'ours':>12}{'ratio':>9}")
    for name, theirs, ours in rows:
        print(f"{name:40}{theirs:12,.0f}{ours:12,.0f}{ours / theirs:8.1f}x")


if __name__ == "__main__":
    main(tyro.cli(Options))
