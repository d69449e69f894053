"""The tasks by name."""

from __future__ import annotations

from eisp_data.errors import ConfigError
from eisp_data.tasks.base import Task
from eisp_data.tasks.open_drawer import OpenDrawer
from eisp_data.tasks.push4 import Push4
from eisp_data.tasks.stack import Stack
from eisp_data.tasks.store import Store

TASKS: dict[str, Task] = {task.name: task for task in (Stack(), Push4(), OpenDrawer(), Store())}


def get_task(name: str) -> Task:
    """Return the task of that name; ConfigError names the choices."""
    if name not in TASKS:
        raise ConfigError(f"unknown task {name!r}; choose one of {', '.join(TASKS)}")
    return TASKS[name]
