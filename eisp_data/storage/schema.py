"""How an Episode's arrays map onto the columns and feature table of a LeRobot v3 dataset."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from eisp_data.storage.spec import DatasetSpec

CODEBASE_VERSION = "v3.0"
SIDECAR_COLUMN = "eisp.episode"
"""String column: JSON in each episode's first row, empty in the others. See ``sidecar.py``."""
SIM_STATE_COLUMN = "sim.state"
"""Outside ``observation.*``, which LeRobot would offer to a policy as input."""
AGE = "age_s."
"""Column with the age of a recording's source; below 0 where the nearest sample came later."""
INTERVENTION = "intervention"
"""The column of a recording that is 1 while a human had taken over."""
IMAGE = "observation.images."
"""What the feature name of every camera begins with."""
REPEATED = "repeated."
"""Column of a recording's camera: 1 in rows that show a frame again, for the next one was lost."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CHUNK_SIZE = 1000
"""Files per chunk folder, LeRobot's default."""
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200

ROW_FEATURES = {
    "observation.state": "float32",
    "observation.environment_state": "float32",
    "observation.achieved_goal": "float32",
    "observation.desired_goal": "float32",
    "action": "float32",
    "next.reward": "float32",
    "next.done": "bool",
    "next.truncated": "bool",
    "next.success": "bool",
    SIM_STATE_COLUMN: "float64",
}
INDEX_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def video_key(camera: str) -> str:
    """Return the feature name of a camera."""
    return f"{IMAGE}{camera}"


def is_standard(name: str) -> bool:
    """Return whether a column has a meaning of its own, so that no extra one can have its name."""
    return name in {*ROW_FEATURES, *INDEX_FEATURES, SIDECAR_COLUMN} or name.startswith(IMAGE)


def column_widths(spec: DatasetSpec) -> dict[str, tuple[str, int]]:
    """Return ``{column: (numpy dtype, width)}`` of the numeric columns, those of width 0 left out.

    The index columns of LeRobot are included; the sidecar and the videos are not numeric.
    """
    widths = {
        "observation.state": spec.proprio_dim,
        "observation.environment_state": spec.observation_dim - spec.proprio_dim,
        "observation.achieved_goal": spec.goal_dim,
        "observation.desired_goal": spec.goal_dim,
        "action": spec.action_dim,
        SIM_STATE_COLUMN: spec.sim_state_dim,
    }
    columns = {
        **{name: (dtype, widths.get(name, 1)) for name, dtype in ROW_FEATURES.items()},
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
