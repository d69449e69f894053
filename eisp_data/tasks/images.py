"""OpenDrawer and Store from pixels: which task's worlds they are, and what their goal looks like.

The worlds, their rewards and their success are those of the state task. Only what a policy sees
differs: an image of the scene, and an image of the goal.
"""

from __future__ import annotations

import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.sim.drawer import HANDLE_CLOSED_M
from eisp_data.tasks.drawer import DrawerTask
from eisp_data.tasks.registry import TASKS

CAMERA = "shoulder"
IMAGE_SIZE = (48, 48)
"""Height and width (paper, appendix "Image-based observation processing")."""
_SUFFIX = "_image"
_LETTING_GO_M = (0.016, 0.0, 0.042)
"""From the handle's bar to the fingers that have just opened the drawer and risen; those that have
shut it are 12 mm further behind the bar, less than two pixels."""
_FINGERS = slice(3, 5)

IMAGE_TASKS: dict[str, DrawerTask] = {
    f"{name}{_SUFFIX}": task for name, task in TASKS.items() if isinstance(task, DrawerTask)
}
"""Name of an image task to the task whose worlds it looks at."""


def image_task(state_task: str) -> str:
    """Return the name of a task's image variant; ConfigError if it has none."""
    name = f"{state_task}{_SUFFIX}"
    if name not in IMAGE_TASKS:
        raise ConfigError(
            f"{state_task!r} has no image variant; there are {', '.join(IMAGE_TASKS)}"
        )
    return name


def state_task(name: str) -> str:
    """Return the name of the task whose worlds these are: itself, unless it is seen in images."""
    return IMAGE_TASKS[name].name if name in IMAGE_TASKS else name


def goal_state(task: DrawerTask, desired_goal: np.ndarray) -> np.ndarray:
    """Return a state (P,) that a camera sees as the goal.

    Block and handle are where the goal (G,) wants them. An image of a goal shows the gripper
    too: it is closed, just above the handle, about as after the last move of either task.
    """
    block, handle = np.asarray(desired_goal, float).reshape(2, 3)
    opening = HANDLE_CLOSED_M[0] - handle[:1]
    state = task.state_of(handle + _LETTING_GO_M, block[None], opening)
    task.qpos(state)[_FINGERS] = 0.0
    return state
