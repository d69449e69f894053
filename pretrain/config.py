"""Every setting of pretraining, each beside its meaning.

Kept apart from the code that it configures because that needs torch, which takes seconds to import;
a command line has to be read before.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from eisp_data.runs import DeviceName
from vqvae.config import VisionConfig


@dataclass(frozen=True)
class SacConfig:
    """Soft Actor-Critic."""

    layers: tuple[int, ...] = (256, 256)
    """Hidden sizes of actor and critics (Table I: pi)."""
    lr: float = 3e-4
    """At the start of pretraining."""
    alpha: float = 0.01
    """Temperature, fixed (Table I: alpha)."""
    gamma: float = 0.99
    """Discount (Table I: gamma)."""
    tau: float = 0.005
    """Share of the critic that enters its target at each update."""
    layer_norm: bool = True
    """Normalise the critics' hidden layers; off in the paper's preset."""
    clip_targets: bool = True
    """Clip the critics' targets to [-1 / (1 - gamma), 0], all that Eq. (1) allows."""
    cloning: float = 20.0
    """Weight of cloning the actions that led to the goal; 0 is plain SAC."""


@dataclass(frozen=True)
class MoversConfig:
    """The mixture generator."""

    width: int = 128
    """Size of all hidden layers."""
    modes: int = 4
    """Places apart from each other where the object that moves may go."""
    likelihood: float = 1.0
    """Weight of L_HS, the negative log-likelihood of the hindsight subgoals."""
    reconstruction: float = 0.01
    """Weight of the decoder's -log p(g | subgoal, s)."""
    divergence: float = 1e-3
    """Weight of KL(encoder || prior)."""
    temperature: float = 0.3
    """Candidates are drawn with the Laplace scales multiplied by this."""


@dataclass(frozen=True)
class HybridConfig:
    """The paper's generator."""

    layers: tuple[int, ...] = (256, 256)
    """Hidden sizes of encoder and decoder (Table I: psi)."""
    beta: float = 1e-2
    """Weight of L_HS (Table I: beta)."""


@dataclass(frozen=True)
class SubgoalConfig:
    """When and how subgoals are chosen during a rollout (the paper's Algorithm 1)."""

    source: Literal["generator", "random", "none", "oracle"] = "generator"
    """The generator, achieved goals drawn from the dataset, the final goal alone, or what the
    task's noise-free script would achieve next."""
    candidates: int = 8
    """K"""
    selector: Literal["value", "likely"] = "likely"
    """``value`` is the paper's Eq. (11); for ``likely`` see ``finetune.selector``."""
    every_steps: int = 30
    """T, the steps that a subgoal may take (Table I)."""
    reached_m: float = 0.02
    """A subgoal is reached within this distance (the paper's epsilon)."""
    final_m: float = 0.05
    """A subgoal this near to the final goal gives way to it (the paper's epsilon)."""
    sample_when_stuck: bool = True
    """Sample the actions towards a subgoal, if the last one was not reached nor come nearer; one
    that fails twice is not chosen again soon."""
    rest_when_met: bool = True
    """When the final goal has been met for a while, let go and stand still. An action of zero has
    to mean that."""


@dataclass(frozen=True)
class GoalMix:
    """Which goals the low-level policy and the generator learn from."""

    waypoint: float = 0.5
    """Share of goals that are the next waypoint: what a subgoal generator will ask for."""
    future: float = 0.3
    """Share of goals achieved a little later in the same trajectory."""
    displaced: float = 0.2
    """Share of goals that send one object to where it lay at another time."""
    pursued: float = 0.0
    """Share of goals that are those that the trajectory was after, whether it met them or not."""
    complete: float = 0.25
    """Share of the generator's samples that lead to the very goal of a demonstration: only few
    show the whole task, and what comes first in it."""
    furthest: float = 0.5
    """Share of the others that lead to the furthest waypoint that is no detour, for far goals are
    what subgoals are for; the rest lead to any on the way there."""
    horizon: int | None = 40
    """How many steps later a ``future`` goal may lie; None: uniformly until the end of the
    trajectory, as in hindsight experience replay (Andrychowicz et al. 2017)."""
    tolerance_m: float = 0.05
    """epsilon of Eq. (1) for these goals: tighter than the task's, because errors add up."""
    errors: float = 0.5
    """Errors are added to these goals, in all this share of the tolerance: those of a trajectory
    are met exactly, those of a rollout never, and what is done well enough must look done."""


@dataclass(frozen=True)
class AgentConfig:
    """An agent's parts."""

    task: str
    """Name of the task, or id of the environment."""
    features: Literal["objects", "plain"] = "objects"
    generator: Literal["movers", "hybrid"] = "movers"
    waypoints: int | None = None
    """The paper's n, which cuts trajectories evenly; None cuts them where objects rest."""
    sac: SacConfig = field(default_factory=SacConfig)
    movers: MoversConfig = field(default_factory=MoversConfig)
    hybrid: HybridConfig = field(default_factory=HybridConfig)
    subgoals: SubgoalConfig = field(default_factory=SubgoalConfig)
    mix: GoalMix = field(default_factory=GoalMix)
    vision: Annotated[VisionConfig | None, tyro.conf.Suppress] = None
    """The VQ-VAE that an image task is seen with; read from --vqvae.path."""


@dataclass(frozen=True)
class VqVaePath:
    """A VQ-VAE on the disk."""

    path: Path | None = None
    """A run of eisp-vqvae train; with it the task is learned from its images."""


@dataclass(frozen=True)
class DatasetConfig:
    """A dataset on the disk."""

    root: Path
    """Its folder."""


@dataclass(frozen=True)
class PretrainConfig:
    """Offline pretraining."""

    dataset: DatasetConfig
    output_dir: Path
    """Where the run goes."""
    agent: AgentConfig
    vqvae: VqVaePath = field(default_factory=VqVaePath)
    updates: int = 60_000
    """Updates of SAC."""
    batch_size: int = 256
    generator_every: int = 4
    """Updates of SAC for one of the generator."""
    generator_batch_size: int = 256
    generator_lr: float = 2e-3
    """Of the generator at the start."""
    final_lr_share: float = 0.1
    """The learning rate of SAC falls linearly to this share of it; 1 keeps it constant."""
    generator_final_lr_share: float = 0.01
    """That of the generator."""
    validation_share: float = 0.1
    """Share of the episodes that are held out."""
    validate_every: int = 1_000
    """Updates between validations, each followed by a checkpoint."""
    seed: int = 0
    device: DeviceName = "auto"
    threads: int = 2
    """Cores for the networks of a processor: critics on one half of them, actor and generator on
    the other; 1 does one after the other. The results of 1 and 2 are the same."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder."""
