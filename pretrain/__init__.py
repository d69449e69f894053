"""All that is learned from data: features, SAC, subgoal generators, offline pretraining."""

import os

# Before torch loads OpenMP: threads that spin while they wait starve each other as soon as the
# machine does anything else. Two threads on two busy cores: 0.6 updates/s spinning, 57 waiting.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
