"""The script of each task, and the noise of its demonstrator."""

from __future__ import annotations

from eisp_data.policies.open_drawer import open_drawer
from eisp_data.policies.push4 import push4
from eisp_data.policies.script import Noise, Script
from eisp_data.policies.stack import stack
from eisp_data.policies.store import store

SCRIPTS: dict[str, Script] = {
    "stack": stack,
    "push4": push4,
    "open_drawer": open_drawer,
    "store": store,
}

DEMONSTRATOR: dict[str, Noise] = {
    "stack": Noise(
        action_std=0.15,
        aim_std_m=0.004,
        blunder=0.15,
        slowest=0.6,
        stumble=0.006,
        partial=True,
        whole_share=0.05,
    ),
    "push4": Noise(
        action_std=0.15,
        aim_std_m=0.004,
        blunder=0.1,
        slowest=0.6,
        stumble=0.005,
        partial=True,
        whole_share=0.06,
    ),
    "open_drawer": Noise(
        action_std=0.15,
        aim_std_m=0.004,
        blunder=0.1,
        slowest=0.6,
        stumble=0.005,
        partial=True,
        whole_share=0.06,
    ),
    "store": Noise(
        action_std=0.15,
        aim_std_m=0.004,
        blunder=0.1,
        slowest=0.6,
        # A stumble while the drawer is being closed may slam it: the whole task by accident.
        stumble=0.004,
        partial=True,
        whole_share=0.04,
        least_s=6.0,
    ),
}
"""Clumsy enough that at most 10% of the episodes succeed (the paper's appendix)."""
