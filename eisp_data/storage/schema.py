"""How an Episode's arrays map onto the columns and feature table of a LeRobot v3 dataset."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from eisp_data.storage.spec import DatasetSpec

CODEBASE_VERSION = "v3.0"
SIDECAR_COLUMN = "eisp.episode"
"""String column: JSON in each episode's first row, empty in the others. See ``sidecar.py``."""
SIM_STATE_COLUMN = "sim.state"
"""Outside ``observation.*``, which LeRobot would offer to a policy as input."""
REPEATED = "repeated."
"""Column of a recording's camera: 1 in rows that show a frame again, for the next one was lost."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CHUNK_SIZE = 1000
"""Files per chunk folder, LeRobot's default."""
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200

INDEX_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def video_key(camera: str) -> str:
    """Return the feature name of a camera."""
    return f"observation.images.{camera}"


def column_widths(spec: DatasetSpec) -> dict[str, tuple[str, int]]:
    """Return ``{column: (numpy dtype, width)}`` of the numeric columns, those of width 0 left out.

    The index columns of LeRobot are included; the sidecar and the videos are not numeric.
    """
    columns = {
        "observation.state": ("float32", spec.proprio_dim),
        "observation.environment_state": ("float32", spec.observation_dim - spec.proprio_dim),
        "observation.achieved_goal": ("float32", spec.goal_dim),
        "observation.desired_goal": ("float32", spec.goal_dim),
        "action": ("float32", spec.action_dim),
        "next.reward": ("float32", 1),
        "next.done": ("bool", 1),
        "next.truncated": ("bool", 1),
        "next.success": ("bool", 1),
        SIM_STATE_COLUMN: ("float64", spec.sim_state_dim),
        **{name: ("float32", width) for name, width in spec.extras.items()},
        **{name: (dtype, 1) for name, dtype in INDEX_FEATURES.items()},
    }
    return {name: kind for name, kind in columns.items() if kind[1] > 0}


def features(spec: DatasetSpec, video_info: Callable[[int, int], dict[str, Any]]) -> dict[str, Any]:
    """Return the ``features`` table of ``meta/info.json``.

    Args:
        spec: the dataset's shapes.
        video_info: what LeRobot records of the encoding of frames of a height and width.
    """
    table: dict[str, Any] = {}
    for name, (dtype, width) in column_widths(spec).items():
        table[name] = {"dtype": dtype, "shape": [width], "names": None}
    table[SIDECAR_COLUMN] = {"dtype": "string", "shape": [1], "names": None}
    for camera, (height, width) in spec.cameras.items():
        table[video_key(camera)] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": video_info(height, width),
        }
    return table
