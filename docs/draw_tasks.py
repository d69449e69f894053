"""Draw docs/tasks.png: each task in the middle of an episode of its oracle, with its goal.

python docs/draw_tasks.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.sim.render import Renderer
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS

WIDTH, HEIGHT = 440, 300
STEP = {"stack": 44, "push4": 52, "open_drawer": 50, "store": 130}
SEED = {"stack": 3, "push4": 5, "open_drawer": 4, "store": 2}
COLOURS = 256


def frame(name: str) -> np.ndarray:
    """Return (H, W, 3) uint8: the task after some steps of its oracle."""
    task = TASKS[name]
    worlds = Worlds(task, 1)
    worlds.reset([SEED[name]])
    policy = ScriptedPolicy(task, SCRIPTS[name], Noise(), 1)
    policy.begin(0, worlds.state, worlds.desired_goal[0], SEED[name])
    for _ in range(STEP[name]):
        worlds.step(policy.act(worlds.state))
    with Renderer(task, width=WIDTH, height=HEIGHT) as renderer:
        return renderer.render(worlds.state[0], worlds.desired_goal[0])


def main() -> None:
    """Draw all four beside each other."""
    rows = [[frame("stack"), frame("push4")], [frame("open_drawer"), frame("store")]]
    picture = Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows]))
    path = Path(__file__).with_name("tasks.png")
    picture.quantize(COLOURS, kmeans=8).save(path, optimize=True)
    print(path, path.stat().st_size // 1024, "KiB")


if __name__ == "__main__":
    main()
