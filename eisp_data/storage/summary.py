"""What a dataset holds, in a few lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.storage.cache import fingerprint
from eisp_data.storage.episodes import read_index
from eisp_data.storage.reader import read_blocks, read_recipe, read_spec


def summary(root: Path | str) -> dict[str, Any]:
    """Return name and value of what one wants to know of a dataset; plain JSON values."""
    root = Path(root)
    spec, index = read_spec(root), read_index(root)
    returns: list[float] = []
    at_last = at_any = 0
    for block in read_blocks(root, spec):
        for offset, sidecar in enumerate(block.sidecars):
            rows = slice(int(block.starts[offset]), int(block.starts[offset + 1]))
            success = block.columns["next.success"][rows]
            at_last += bool(success[-1])
            at_any += bool(success.any() or sidecar.first_success)
            returns.append(float(block.columns["next.reward"][rows].sum(dtype=np.float64)))
    files = [path for path in root.rglob("*") if path.is_file() and ".cache" not in path.parts]
    lengths = index.length
    facts: dict[str, Any] = {
        "task": spec.task,
        "instruction": spec.instruction,
        "robot": spec.robot_type,
        "episodes": len(index),
        "frames": int(lengths.sum()),
        "frames_per_episode": f"{lengths.min()} to {lengths.max()}" if len(index) else "-",
        "rate_hz": spec.fps,
        "duration_min": round(float(lengths.sum()) / spec.fps / 60, 2),
        "observation_dim": spec.observation_dim,
        "goal_dim": spec.goal_dim,
        "action_dim": spec.action_dim,
        "sim_state_dim": spec.sim_state_dim,
        "cameras": {name: list(size) for name, size in spec.cameras.items()},
        "success_at_last": at_last,
        "success_at_any": at_any,
        "mean_return": round(float(np.mean(returns)), 3) if returns else None,
        "size_mb": round(sum(path.stat().st_size for path in files) / 1e6, 3),
        "fingerprint": fingerprint(root),
        "recipe": read_recipe(root),
    }
    return {**facts, "extras": dict(spec.extras)} if spec.extras else facts
