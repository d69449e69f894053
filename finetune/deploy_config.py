"""Every setting of deployment, each beside its meaning; free of torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from eisp_data.robots.session_cell import CellConfig
from finetune.config import PolicyConfig
from pretrain.config import DeviceName, SubgoalConfig


@dataclass(frozen=True, kw_only=True)
class DeployConfig(CellConfig):
    """A policy on a robot."""

    output_dir: Path
    """Where recording, films, curve and results go."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    control: Literal["policy", "script"] = "policy"
    """script: the task's script on what is perceived, to tell what perception and motion lose from
    what the policy loses."""
    subgoals: SubgoalConfig = field(default_factory=SubgoalConfig)
    look: bool = True
    """Withdraw the arm after each subgoal, so that the camera sees all."""
    ticks_per_step: int = 2
    """Ticks of the robot for each step of the policy, which was trained at 1 m/s: more are slower
    and gentler."""
    episodes: int = 1
    episode_s: float | None = None
    """The longest that an episode may last; the task's steps, and the looks, if left out."""
    pause_s: float = 30.0
    """Between two episodes a human has so long to set the table, or presses enter before."""
    interference: bool = False
    """On the twin: in each episode a hand takes one object away after its subtask is done."""
    record_images: bool = True
    """Record the camera, and film each episode with subgoals and goal drawn in."""
    resume: bool = False
    """Go on with the episodes of the output folder until there are as many."""
    device: DeviceName = "cpu"
    threads: int = 1
    """Threads of the networks on a processor."""
