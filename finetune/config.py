"""Every setting of fine-tuning and evaluation, each beside its meaning; free of torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pretrain.config import AgentConfig, DeviceName, SubgoalConfig


@dataclass(frozen=True)
class OnlineConfig:
    """Online fine-tuning."""

    rounds: int = 100
    worlds: int = 32
    round_steps: int = 50
    """Steps of every world in a round."""
    updates: int = 300
    """Updates of SAC in a round."""
    batch_size: int = 256
    offline_share: float = 0.5
    """Share of each batch that comes from the dataset."""
    pursued: float = 0.5
    """Share of the other goals that are the subgoals that were pursued, met or not: where the
    policy fails is learned from these alone."""
    noise: float = 0.5
    """Share of the policy's noise that its actions have: with all of it a good policy fails often
    enough to unlearn what it could."""
    lr: float = 5e-5
    """Of SAC at the start: less than pretraining ends with, or what it settled is stirred up
    again. It falls linearly to a tenth."""
    generator_every: int = 4
    """Updates of SAC for one of the generator, which learns from old and new data by their
    amounts; 0 leaves it as it is."""
    generator_batch_size: int = 256
    generator_lr: float = 3e-4
    """At the start; it falls with the other."""
    replay_size: int = 1_000_000
    """Rows kept of the worlds' trajectories (Table I: D)."""
    evaluate_every: int = 10
    """Rounds between evaluations, each followed by a checkpoint."""
    evaluation_episodes: int = 100
    """A policy that looks best in them has to show it in three times as many more."""


@dataclass(frozen=True)
class PolicyConfig:
    """A policy on the disk."""

    path: Path | None = None
    """A run, a checkpoint, or a folder with ``model.safetensors``."""


@dataclass(frozen=True)
class DataConfig:
    """The dataset that fine-tuning goes on learning from."""

    root: Path | None = None
    """Its folder; that of the pretraining if left out."""


@dataclass(frozen=True)
class EnvConfig:
    """An environment from elsewhere."""

    id: str | None = None
    """A registered Gymnasium GoalEnv, for example FetchPickAndPlace-v4, or MODULE:ID. Without a
    policy, learning starts from nothing, after some episodes of random actions."""


@dataclass(frozen=True)
class FinetuneConfig:
    """Online fine-tuning."""

    output_dir: Path
    """Where the run goes."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    dataset: DataConfig = field(default_factory=DataConfig)
    subgoals: SubgoalConfig = field(default_factory=SubgoalConfig)
    online: OnlineConfig = field(default_factory=OnlineConfig)
    seed: int = 0
    device: DeviceName = "auto"
    threads: int = 2
    """Cores for the networks of a processor: critics on one half of them, actor and generator on
    the other; 1 does one after the other. The results of 1 and 2 are the same."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder."""


def from_nothing(output_dir: Path, agent: AgentConfig) -> FinetuneConfig:
    """Return what to begin with without a policy: a fresh agent's own settings, and all of its
    noise, for nothing can be unlearned yet."""
    online = OnlineConfig(noise=1.0, lr=agent.sac.lr)
    return FinetuneConfig(output_dir, subgoals=agent.subgoals, online=online)


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluation of a policy."""

    policy: PolicyConfig
    episodes: int = 500
    seed: int = 1000
    """Seed of the first episode; the others follow it."""
    subgoals: SubgoalConfig = field(default_factory=SubgoalConfig)
    json: bool = False
    """Print JSON instead of a table."""
    video: Path | None = None
    """Film the first episode, with subgoals and goal drawn in, into this MP4 file."""
    device: DeviceName = "auto"
    threads: int = 1
    """Threads of the networks on a processor."""
