"""Small random episodes, and what it means for two to be the same."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from eisp_data.episode import Episode
from eisp_data.storage.spec import DatasetSpec

CAMERA = {"top": (48, 48)}


def spec_of(cameras: bool = False, **changes: object) -> DatasetSpec:
    """Return the spec of the small test datasets."""
    values: dict[str, object] = {
        "task": "stack",
        "instruction": "Stack the blocks.",
        "observation_dim": 12,
        "goal_dim": 3,
        "action_dim": 4,
        "sim_state_dim": 5,
        "cameras": CAMERA if cameras else {},
    }
    return DatasetSpec(**{**values, **changes})  # type: ignore[arg-type]


def random_episode(spec: DatasetSpec, steps: int, seed: int) -> Episode:
    """Return an episode of noise with every array filled, images smooth enough for video."""
    rng = np.random.default_rng(seed)
    observations = steps + 1

    def noise(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    images = {}
    for camera, (height, width) in spec.cameras.items():
        ramp = np.linspace(0, 120, height * width * 3).reshape(height, width, 3)
        levels = ramp + 10 * (seed % 7) + np.arange(observations)[:, None, None, None]
        images[camera] = levels.astype(np.uint8)
    return Episode(
        observation=noise(observations, spec.observation_dim),
        achieved_goal=noise(observations, spec.goal_dim),
        desired_goal=noise(spec.goal_dim),
        action=rng.uniform(-1, 1, (steps, spec.action_dim)).astype(np.float32),
        reward=-(rng.random(steps) < 0.5).astype(np.float32),
        done=rng.random(steps) < 0.2,
        truncated=rng.random(steps) < 0.2,
        success=rng.random(observations) < 0.5,
        sim_state=rng.normal(size=(observations, spec.sim_state_dim)),
        seed=seed,
        info={"policy": "script", "noise": 0.1 * seed, "level": seed, "ok": seed % 2 == 0},
        images=images,
    )


def assert_same(ours: Episode, theirs: Episode) -> None:
    """Fail unless two episodes are equal to the last bit; images, being video, only in shape."""
    for name in (field.name for field in fields(Episode)):
        a, b = getattr(ours, name), getattr(theirs, name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape, name
            assert a.tobytes() == b.tobytes(), name
        elif name != "images":
            assert a == b, name
