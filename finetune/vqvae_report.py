"""A page on a VQ-VAE: its loss, its images, and the subgoals that a policy proposes in its latents.

The paper's figures "vqvae-loss" and "subgoals-2": originals above what comes back from their codes,
and along an episode the current image above the decoded subgoal.
"""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from eisp_data.errors import ConfigError, DataError
from eisp_data.runs.episodes import rows_of, split
from eisp_data.storage.cache import load_arrays, load_images
from eisp_data.storage.files import replace_atomically
from finetune.charts import Series, line_chart
from finetune.page import page
from finetune.report import read_metrics
from finetune.rollout import SubgoalPolicy
from finetune.run import load_for_rollouts
from pretrain.saved import saved_subgoals
from vqvae.evaluate import evaluate, training_of
from vqvae.model import VqVae
from vqvae.saved import load
from vqvae.train import spread
from vqvae.worlds import ImageWorlds

_PICTURES = 12
_ZOOM = 3
_GAP = 2
_BLUE, _TEAL = "#2563eb", "#0d9488"
_STRIP_STEPS = 10
"""Steps between two pictures of an episode, 0.4 s: most of it is over after a hundred."""


def write_vqvae_report(
    path: Path, policy: Path | None, seed: int, output: Path | None = None
) -> Path:
    """Write the page; return where it is.

    Args:
        path: the run of the VQ-VAE.
        policy: of an image task, for the strip of subgoals; none is drawn without.
        seed: of the episode that is drawn.
        output: the page; ``report.html`` in the run if left out.
    """
    model, vision = load(path)
    curves = _curves(path)
    sections = [
        f"<h1>VQ-VAE of {escape(vision.task)}</h1>",
        f'<div class="box"><pre>{escape(evaluate(path).table())}</pre></div>',
        "<h2>Training</h2>",
        f'<div class="pair">{"".join(curves)}</div>',
        "<h2>Originals, and what comes back from their codes</h2>",
        "<p>Frames of episodes that it was not trained on; below each its reconstruction.</p>",
        _figure(reconstructions(path, model, vision.camera)),
    ]
    if policy is not None:
        sections += [
            "<h2>Subgoals</h2>",
            "<p>One episode, a picture every 0.4 s: what the camera sees, and below it the decoded "
            "subgoal that the policy was heading for. The last column is the goal.</p>",
            _figure(subgoal_strip(policy, model, seed)),
        ]
    target = output or path / "report.html"
    text = page(f"VQ-VAE of {vision.task}", sections)
    replace_atomically(target, lambda draft: draft.write_text(text, encoding="utf-8"))
    return target


def reconstructions(path: Path, model: VqVae, camera: str) -> np.ndarray:
    """Return one picture (H, W, 3): held-out images above what comes back from their codes."""
    config = training_of(path)
    root = config.dataset.root
    arrays = load_arrays(root)
    held, _ = split(arrays.num_episodes, config.validation_share, config.seed)
    images = np.array(load_images(root, camera)[spread(rows_of(arrays, held), _PICTURES)])
    again = model.decode(model.embed(model.encode(torch.from_numpy(images)))).numpy()
    return strip(images, again)


def subgoal_strip(policy: Path, model: VqVae, seed: int) -> np.ndarray:
    """Return one picture (H, W, 3): images of an episode above the subgoals of the policy.

    Raises:
        ConfigError: the policy is not one of an image task.
        DataError: it sees with another VQ-VAE.
    """
    agent = load_for_rollouts(policy, saved_subgoals(policy), "cpu")
    if agent.vision is None or agent.config.vision is None:
        raise ConfigError(f"{policy} is a policy of {agent.config.task!r}, which has no images")
    if agent.vision.fingerprint() != model.fingerprint():
        raise DataError(f"{policy} sees with another codebook than the VQ-VAE of this report")
    worlds = ImageWorlds(agent.config.task, agent.vision, agent.config.vision, 1)
    worlds.reset([seed])
    rollout = SubgoalPolicy(agent, 1)
    seen: list[np.ndarray] = []
    headed: list[np.ndarray] = []
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for step in range(worlds.episode_steps):
            before = worlds.observation, worlds.achieved_goal, worlds.desired_goal
            action = rollout.act(*before)
            if step % _STRIP_STEPS == 0 and len(seen) < _PICTURES - 1:
                seen.append(worlds.images()[0])
                headed.append(rollout.subgoal[0].copy())
            worlds.step(action)
    seen.append(worlds.images()[0])
    headed.append(worlds.desired_goal[0])
    latents = torch.from_numpy(np.stack(headed))[:, model.places :]
    decoded = agent.vision.decode(latents).numpy()
    return strip(np.stack(seen), decoded)


def strip(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Return (N, H, W, 3) images side by side, each above another, enlarged and a little apart."""
    height, width = above.shape[1:3]
    paper = np.full((2 * (height + _GAP), len(above) * (width + _GAP), 3), 255, np.uint8)
    for row, images in enumerate((above, below)):
        for column, image in enumerate(images):
            top, left = row * (height + _GAP), column * (width + _GAP)
            paper[top : top + height, left : left + width] = image
    return paper.repeat(_ZOOM, axis=0).repeat(_ZOOM, axis=1)


def _curves(path: Path) -> list[str]:
    """Return charts of the loss and of the PSNR."""
    entries = read_metrics(path / "metrics.jsonl")
    if not entries:
        raise DataError(f"{path} holds no run of eisp-vqvae train: metrics.jsonl is missing")
    updates = [entry["updates"] for entry in entries]

    def series(name: str, key: str, colour: str) -> Series:
        return Series(name, updates, [entry[key] for entry in entries], colour)

    return [
        line_chart("loss", "updates", [series("loss", "train/loss", _BLUE)]),
        line_chart(
            "PSNR of held-out images, dB", "updates", [series("PSNR", "held_out/psnr_db", _TEAL)]
        ),
    ]


def _figure(picture: np.ndarray) -> str:
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    coded = base64.b64encode(data.getvalue()).decode()
    image = f'<img alt="" style="width:100%" src="data:image/png;base64,{coded}">'
    return f'<div class="box">{image}</div>'
