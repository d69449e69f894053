"""Offline pretraining: SAC on hindsight goals and the generator on hindsight subgoals."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from eisp_data.config import load_yaml
from eisp_data.errors import DataError
from eisp_data.runs.episodes import hold_out, rows_of
from eisp_data.runs.folder import begin_run, check_same_dataset, has_progress
from eisp_data.runs.metrics import MetricsLog
from eisp_data.storage.cache import DatasetArrays
from eisp_data.tasks.images import state_task
from eisp_data.tasks.registry import TASKS
from pretrain import checkpoint
from pretrain.agent import BANK, Agent
from pretrain.checks import check_pretrain
from pretrain.config import PretrainConfig
from pretrain.device import describe, set_up
from pretrain.layout import Layout
from pretrain.learner import Learner, Sample, threads_of_half
from pretrain.replay import Trajectories
from pretrain.vision import check_resumed, load_seen, load_vision
from vqvae.model import VqVae

_VALIDATION_SAMPLES = 4096
_NEAR_M = 0.05
CONFIG_FILE = "pretrain.yaml"


def pretrain(config: PretrainConfig) -> Path:
    """Pretrain an agent; return the folder of the run."""
    run = config.output_dir
    check_pretrain(config)
    resumed = has_progress(run, config.resume, CONFIG_FILE)
    if resumed:
        begun = load_yaml(PretrainConfig, run / CONFIG_FILE)
        check_same_dataset(begun.dataset.root, config.dataset.root, run / CONFIG_FILE)
    device = set_up(config.device, threads_of_half(config.threads))
    vision = load_vision(config)
    train, held_out, layout = load_trajectories(config, vision)
    print(describe(device, config.threads), flush=True)
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    bank = train.achieved_goal[rng.integers(len(train), size=BANK)]
    agent = Agent(config.agent, layout, train.moments(), torch.from_numpy(bank)).to(device)
    if agent.vision and vision:
        agent.vision.load_state_dict(vision.state_dict())
    learner = Learner(agent, config.agent.sac.lr, config.generator_lr, config.threads)
    done, best, best_state, spent, finished = 0, -np.inf, {}, 0.0, False
    if resumed:
        done, numbers, arrays = checkpoint.restore(run, agent, learner.optimizers, rng)
        check_resumed(agent, vision, config.vqvae.path)
        best, spent, finished = numbers["best"], numbers["wall_s"], numbers["finished"]
        best_state = {name: torch.from_numpy(value) for name, value in arrays.items()}
    begin_run(run, config, CONFIG_FILE)
    log = MetricsLog(run, "pretrain", done)
    start = time.monotonic() - spent
    info: dict[str, Tensor] = {}

    def save() -> None:
        numbers = {"best": best, "wall_s": spent, "finished": finished}
        arrays = {name: value.cpu().numpy() for name, value in best_state.items()}
        checkpoint.save(run, done, agent, learner.optimizers, rng, numbers, arrays)

    def samples(updates: range) -> Iterator[Sample]:
        for update in updates:
            batch = train.transitions(config.batch_size, config.agent.mix, rng)
            hindsight = None
            if update % config.generator_every == 0:
                hindsight = train.subgoals(config.generator_batch_size, config.agent.mix, rng)
            yield Sample(batch, hindsight)

    bar = tqdm(None, "pretraining", config.updates, initial=done, mininterval=1.0)
    while done < config.updates:
        until = min(done + config.validate_every - done % config.validate_every, config.updates)
        updates = range(done + 1, until + 1)
        learning = learner.updates(samples(updates), config.agent.sac.cloning)
        for update in updates:
            remaining = 1.0 - update / config.updates
            learner.set_lr(
                config.agent.sac.lr * max(config.final_lr_share, remaining),
                config.generator_lr * max(config.generator_final_lr_share, remaining),
            )
            info |= next(learning)
            bar.update()
        held = validate(agent, held_out, device)
        if float(held["log_likelihood"]) > best:
            best = float(held["log_likelihood"])
            state = agent.proposer.state_dict()
            best_state = {name: value.clone() for name, value in state.items()}
        bar.set_postfix(_in_words(held))
        done, spent = until, time.monotonic() - start
        values = {f"train/{k}": v for k, v in info.items()}
        values |= {f"held_out/{k}": v for k, v in held.items()}
        log.write(done, 0, spent, values)
        finished = False
        if done < config.updates:
            save()
    bar.close()
    log.close()
    if not finished:
        agent.proposer.load_state_dict(best_state)
        finished = True
        save()
    said = ", ".join(f"{k} {v}" for k, v in _in_words(validate(agent, held_out, device)).items())
    print(f"held-out subgoals: {said}")
    return run


def _in_words(held: dict[str, Tensor]) -> dict[str, str]:
    """Return what ``validate`` found as is said of it."""
    return {
        "likelihood": f"{float(held['log_likelihood']):.2f}",
        "near the data": f"{float(held['near_data']):.0%}",
    }


@torch.no_grad()
def validate(agent: Agent, held_out: Trajectories, device: str) -> dict[str, Tensor]:
    """Return the generator's losses on held-out episodes, and how its likeliest subgoals fare.

    ``hits`` is the share within 5 cm of what was reached next; ``near_data`` the share of which
    no object is further than 5 cm from where it was in some arrangement of the bank.
    """
    rng = np.random.default_rng(0)
    sample = held_out.subgoals(_VALIDATION_SAMPLES, agent.config.mix, rng)
    observation, goal, subgoal = (tensor.to(device) for tensor in sample)
    _, info = agent.proposer.loss(observation, goal, subgoal)
    proposed = agent.proposer.propose(observation, goal, 1)[0][:, 0]
    layout = agent.layout
    hits = layout.apart(proposed, subgoal).norm(dim=-1) <= _NEAR_M
    each = 3 if layout.objects else layout.goal_dim
    way = layout.apart(proposed[:256, None], agent.bank[None])
    apart = way.unflatten(-1, (-1, each)).norm(dim=-1).amax(-1).amin(-1)
    near = apart <= _NEAR_M
    return info | {"hits": hits.float().mean(), "near_data": near.float().mean()}


def load_trajectories(
    config: PretrainConfig, vision: VqVae | None = None
) -> tuple[Trajectories, Trajectories, Layout]:
    """Read the dataset into memory, split by episode into what is learned from and held out."""
    arrays = load_seen(config.dataset.root, config.agent, vision)
    layout = layout_of(arrays, 0 if vision is None else vision.latent_dim)
    held, rest = hold_out(config.dataset.root, arrays, config.validation_share, config.seed)
    parts = config.agent.waypoints
    held_out = gather(arrays, held, layout, parts)
    train = gather(arrays, rest, layout, parts)
    for name, data in (("training", train), ("held-out", held_out)):
        if not len(data.leading):
            raise DataError(f"{config.dataset.root}: nothing ever moves in its {name} episodes")
    return train, held_out, layout


def layout_of(arrays: DatasetArrays, latent_dim: int = 0) -> Layout:
    """Return the layout of a dataset's environment.

    Args:
        arrays: of the dataset.
        latent_dim: components of the latent of an image, none if it is not seen in images.

    A recording of a robot may be of a task of ours and yet have an observation of its own.
    """
    spec = arrays.spec
    if latent_dim:
        return Layout.of(TASKS[state_task(spec.task)]).seen(latent_dim)
    plain = Layout(spec.observation_dim, spec.goal_dim, spec.action_dim)
    known = Layout.of(TASKS[spec.task]) if spec.task in TASKS else plain
    return known if known.sizes == plain.sizes else plain


def gather(
    arrays: DatasetArrays, episodes: np.ndarray, layout: Layout, parts: int | None
) -> Trajectories:
    """Copy the named episodes into memory."""
    rows, lengths = rows_of(arrays, episodes), np.diff(arrays.episode_start)[episodes]
    data = Trajectories(layout, len(rows), parts, purposeful=True)
    data.extend(
        arrays.observation[rows],
        arrays.achieved_goal[rows],
        arrays.action[rows],
        np.repeat(arrays.desired_goal[episodes], lengths, axis=0),
        np.concatenate([[0], np.cumsum(lengths)]),
        None if arrays.places is None else arrays.places[rows],
        arrays.success[rows],
    )
    return data
