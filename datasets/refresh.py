"""Make all in this folder but recipes and policies anew: ``python datasets/refresh.py [NAME ...]``.

To be run, and its output committed, whenever a scene, a task, a script or its noise has changed.
For each recipe it writes the expected statistics, the card and the picture of the first 100
episodes; and then the sample, two whole episodes with a small camera. It takes some minutes.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from eisp_data.cli.collect import CollectConfig, collect
from eisp_data.config import load_yaml
from eisp_data.replay import render
from eisp_data.storage.card import PREVIEW, dataset_card
from eisp_data.storage.summary import summary
from eisp_data.view import preview_png

HERE = Path(__file__).parent
SAMPLE = "sample"
LICENSE = "apache-2.0"
EPISODES = 100
_NOT_EXPECTED = ("size_mb", "fingerprint")
"""Depend on more than the recipe, such as the version of a compressor."""
_MADE = """Made by `eisp-collect --config datasets/{name}.yaml`; the numbers here are of its
first {episodes} episodes, and the picture is a storyboard of the first, spheres its goal and cubes
its subgoals.

"""
_FIRST_SECTION = "## Task and shapes\n"


def refresh_recipe(name: str, scratch: Path) -> None:
    """Write what to expect of the recipe ``name``; the episodes themselves go into ``scratch``."""
    data = scratch / name
    recipe = load_yaml(CollectConfig, HERE / f"{name}.yaml")
    collect(replace(recipe, output_dir=data, episodes=EPISODES))
    card = dataset_card(data, LICENSE, preview=f"{name}.png")
    before, section, after = card.partition(_FIRST_SECTION)
    made = _MADE.format(name=name, episodes=EPISODES)
    facts = {key: value for key, value in summary(data).items() if key not in _NOT_EXPECTED}
    (HERE / f"{name}.md").write_text(before + made + section + after)
    (HERE / f"{name}.json").write_text(json.dumps(facts, indent=2, ensure_ascii=False) + "\n")
    (HERE / f"{name}.png").write_bytes(preview_png(data))


def refresh_sample(scratch: Path) -> None:
    """Write the sample dataset: small enough for a repository, and it shows the task done."""
    data, drawn = scratch / "oracle", scratch / SAMPLE
    collect(CollectConfig(data, "stack", policy="oracle", episodes=2, seed=1))
    render(data, drawn, {"front": (48, 48)})
    (drawn / "README.md").write_text(dataset_card(drawn, LICENSE))
    (drawn / PREVIEW).write_bytes(preview_png(drawn))
    shutil.rmtree(HERE / SAMPLE)
    shutil.copytree(drawn, HERE / SAMPLE, ignore=shutil.ignore_patterns(".cache"))


def main() -> None:
    """Refresh what the command line names: recipes or the sample; everything if nothing."""
    recipes = sorted(path.stem for path in HERE.glob("*.yaml"))
    known = [*recipes, SAMPLE]
    chosen = sys.argv[1:] or known
    for name in chosen:
        if name not in known:
            sys.exit(f"error: unknown dataset {name!r}; choose from {', '.join(known)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen:
            print(f"== {name}", flush=True)
            if name == SAMPLE:
                refresh_sample(Path(folder))
            else:
                refresh_recipe(name, Path(folder))


if __name__ == "__main__":
    main()
