"""A fine-tuning run from its configuration: worlds, agent and dataset put together."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from eisp_data.collect import explore
from eisp_data.config import above_zero, at_least, check_seed, load_yaml, zero_to_one
from eisp_data.errors import ConfigError
from eisp_data.runs.folder import begin_run, check_same_dataset, folders_of_run, has_progress
from eisp_data.seeds import LAST_SEED, episode_seeds
from eisp_data.sim.gym_worlds import AnyWorlds, GymWorlds
from eisp_data.sim.worlds import Worlds
from eisp_data.storage.files import write_json
from eisp_data.tasks.registry import TASKS
from finetune.config import FinetuneConfig
from finetune.train import Finetuner
from pretrain.agent import BANK, Agent
from pretrain.checks import check_subgoals
from pretrain.config import PretrainConfig, SubgoalConfig
from pretrain.device import describe, set_up
from pretrain.layout import Layout
from pretrain.learner import threads_of_half
from pretrain.presets import preset
from pretrain.replay import Trajectories
from pretrain.saved import find_policy
from pretrain.train import CONFIG_FILE, gather
from pretrain.vision import load_seen
from vqvae.worlds import ImageWorlds

_SETTINGS = "finetune.yaml"
_FIRST_EPISODES = 100
"""Episodes of random actions before learning from nothing."""


def finetune(config: FinetuneConfig) -> dict[str, float]:
    """Fine-tune an agent; return the summary that is also in ``summary.json`` of the run."""
    run = config.output_dir
    _check(config)
    resumed = has_progress(run, config.resume, _SETTINGS)
    if resumed:
        _check_same(load_yaml(FinetuneConfig, run / _SETTINGS), config)
    device = set_up(config.device, threads_of_half(config.threads))
    print(describe(device, config.threads), flush=True)
    torch.manual_seed(config.seed)
    if config.policy.path is None:
        if config.env.id is None:
            raise ConfigError("give --policy.path, a pretrained policy, or --env.id to start anew")
        agent, data = _from_nothing(config.env.id, config.seed)
    else:
        agent = Agent.load(find_policy(config.policy.path))
        data = _dataset(config, agent)
    name = config.env.id or agent.config.task
    if name != agent.config.task:
        raise ConfigError(
            f"{config.policy.path} is a policy of {agent.config.task!r}, not {name!r}"
        )
    agent.config = replace(agent.config, subgoals=config.subgoals)
    finetuner = Finetuner(
        run,
        agent.to(device),
        data,
        lambda count: make_worlds(agent, count),
        config.online,
        config.seed,
        config.threads,
    )
    if resumed:
        finetuner.restore()
    begin_run(run, config, _SETTINGS)
    if config.policy.path and not resumed:
        _keep_history(config.policy.path, run)
    summary = finetuner()
    write_json(run / "summary.json", summary)
    return summary


def _check(config: FinetuneConfig) -> None:
    online = config.online
    check_seed(config.seed)
    at_least(0, {"--online.generator-every": online.generator_every})
    at_least(
        1,
        {
            "--online.rounds": online.rounds,
            "--online.worlds": online.worlds,
            "--online.round-steps": online.round_steps,
            "--online.updates": online.updates,
            "--online.batch-size": online.batch_size,
            "--online.generator-batch-size": online.generator_batch_size,
            "--online.evaluate-every": online.evaluate_every,
            "--online.evaluation-episodes": online.evaluation_episodes,
            "--threads": config.threads,
        },
    )
    at_least(online.round_steps + 1, {"--online.replay-size": online.replay_size})
    above_zero({"--online.lr": online.lr, "--online.generator-lr": online.generator_lr})
    zero_to_one(
        {
            "--online.offline-share": online.offline_share,
            "--online.pursued": online.pursued,
            "--online.noise": online.noise,
        }
    )
    check_subgoals(config.subgoals, "--subgoals")


def _check_same(begun: FinetuneConfig, given: FinetuneConfig) -> None:
    """Raise ConfigError if a run to resume began with another policy, environment or dataset."""
    file = given.output_dir / _SETTINGS
    for flag, was, now in (
        ("--policy.path", *(c.policy.path and c.policy.path.resolve() for c in (begun, given))),
        ("--env.id", begun.env.id, given.env.id),
    ):
        if was != now:
            raise ConfigError(
                f"--resume: the run began with {flag} {was}, not {now}; if it has moved, say so in "
                f"{file}"
            )
    if given.policy.path is not None:
        check_same_dataset(_root(begun), _root(given), file)


def make_worlds(agent: Agent, count: int) -> AnyWorlds:
    """Return worlds of the agent's task, or of a registered GoalEnv, as the agent sees them."""
    name = agent.config.task
    if agent.vision and agent.config.vision:
        return ImageWorlds(name, agent.vision, agent.config.vision, count)
    if name in TASKS:
        check_layout(agent, Layout.of(TASKS[name]))
        return Worlds(TASKS[name], count)
    try:
        worlds = GymWorlds(name, count)
    except ConfigError as error:
        raise ConfigError(
            f"the policy is of {name!r}, which is no task that can be simulated here ({error})"
        ) from None
    check_layout(agent, Layout(worlds.observation_dim, worlds.goal_dim, worlds.action_dim))
    return worlds


def check_layout(agent: Agent, wanted: Layout) -> None:
    """Raise ConfigError unless an agent's arrays have the sizes of an environment's: a recording
    that it learned from may have had others under the same name."""
    if agent.layout.sizes != wanted.sizes:
        raise ConfigError(
            f"the policy takes observations, goals and actions of {agent.layout.sizes} numbers; "
            f"those of {agent.config.task!r} have {wanted.sizes}"
        )


def load_for_rollouts(path: Path | None, subgoals: SubgoalConfig, device: str) -> Agent:
    """Read a policy and set how it chooses its subgoals."""
    if path is None:
        raise ConfigError("missing --policy.path, the folder of a policy")
    agent = Agent.load(find_policy(path), device)
    agent.config = replace(agent.config, subgoals=subgoals)
    return agent


def _dataset(config: FinetuneConfig, agent: Agent) -> Trajectories:
    """Return all episodes of the dataset that the agent was pretrained on."""
    root = _root(config)
    if config.dataset.root is None and not root.exists():
        raise ConfigError(
            f"{config.policy.path} was pretrained on {root}, which is not there; give "
            "--dataset.root"
        )
    arrays = load_seen(root, agent.config, agent.vision)
    every = np.arange(arrays.num_episodes)
    return gather(arrays, every, agent.layout, agent.config.waypoints)


def _root(config: FinetuneConfig) -> Path:
    """Return the dataset of a run: its own, or that which its policy was pretrained on."""
    if config.dataset.root is not None:
        return config.dataset.root
    path = config.policy.path
    assert path is not None
    for folder in folders_of_run(path):
        if (folder / CONFIG_FILE).exists():
            return load_yaml(PretrainConfig, folder / CONFIG_FILE).dataset.root
    raise ConfigError(f"{path} does not say what it was pretrained on; give --dataset.root")


def _keep_history(policy: Path, run: Path) -> None:
    """Start the run's metrics with those of the pretraining, so that one curve shows both."""
    for folder in folders_of_run(policy):
        history = folder / "metrics.jsonl"
        if history.exists():
            shutil.copy(history, run / "metrics.jsonl")
            return


def _from_nothing(env_id: str, seed: int) -> tuple[Agent, Trajectories]:
    """Return a fresh agent for an environment, and episodes of random actions in it."""
    if seed > LAST_SEED:
        raise ConfigError(f"--seed must be 0 to {LAST_SEED} without a policy; got {seed}")
    worlds = GymWorlds(env_id, 1)
    layout = Layout(worlds.observation_dim, worlds.goal_dim, worlds.action_dim)
    config = preset("cpu", env_id, Path(), Path()).agent
    episodes = list(explore(worlds, episode_seeds(seed, 0, _FIRST_EPISODES)))
    worlds.close()
    data = Trajectories(layout, 10**9, config.waypoints, purposeful=False)
    data.extend(
        np.concatenate([episode.observation for episode in episodes]),
        np.concatenate([episode.achieved_goal for episode in episodes]),
        np.concatenate([np.pad(episode.action, ((0, 1), (0, 0))) for episode in episodes]),
        np.concatenate([np.tile(e.desired_goal, (len(e) + 1, 1)) for e in episodes]),
        np.cumsum([0, *(len(episode) + 1 for episode in episodes)]),
    )
    drawn = np.random.default_rng(seed).integers(len(data), size=BANK)
    bank = torch.from_numpy(data.achieved_goal[drawn])
    return Agent(config, layout, data.moments(), bank), data
