"""The card of a dataset: its README on a Hub, written from what the dataset itself says."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from eisp_data.storage.files import read_json
from eisp_data.storage.summary import summary

CITATION = """@misc{eisp,
  title = {Explicit-Implicit Subgoal Planning for Long-Horizon Tasks},
  note = {Collected with the EISP toolkit}
}"""
PREVIEW = "preview.png"


def dataset_card(
    root: Path, license_name: str, citation: str = CITATION, preview: str = PREVIEW
) -> str:
    """Return the card of a dataset in Markdown, with the metadata block that Hubs read.

    Args:
        root: the dataset.
        license_name: identifier of the licence as Hubs know it, for example ``apache-2.0``.
        citation: BibTeX.
        preview: address of the picture, relative to the card.
    """
    facts = summary(root)
    header = {
        "license": license_name,
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "EISP", facts["task"]],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    episodes = facts["episodes"]
    share = facts["success_at_last"] / episodes if episodes else 0.0
    lines = [
        "---",
        yaml.safe_dump(header, sort_keys=False).strip(),
        "---",
        "",
        f"# {facts['task']}: {facts['instruction']}",
        "",
        f"![Preview]({preview})",
        "",
        f"{episodes} episodes, {facts['frames']} frames at {facts['rate_hz']} Hz "
        f"({facts['duration_min']} minutes). {facts['success_at_last']} of them "
        f"({share:.1%}) succeed at the last observation, {facts['success_at_any']} at any.",
        "",
        "## Task and shapes",
        "",
        *_table({k: facts[k] for k in facts if k not in ("recipe", "fingerprint")}),
        "",
        "## How it was collected",
        "",
        "```json",
        json.dumps(facts["recipe"], indent=2, ensure_ascii=False),
        "```",
        "",
        "## Statistics",
        "",
        *_statistics(root),
        "",
        "## Use",
        "",
        "It is a LeRobot v3.0 dataset. The text column `eisp.episode` holds, in the first row of "
        "each episode, what v3 has no place for: the last observation, the seed, the simulator "
        "state; `eisp_data.storage.lerobot.read_episodes` returns whole episodes.",
        "",
        "## Licence and citation",
        "",
        f"Licence: {license_name}",
        "",
        "```bibtex",
        citation,
        "```",
        "",
    ]
    return "\n".join(lines)


def _table(facts: Mapping[str, Any]) -> list[str]:
    rows = [f"| {name.replace('_', ' ')} | {value} |" for name, value in facts.items()]
    return ["| | |", "|---|---|", *rows]


def _statistics(root: Path) -> list[str]:
    stats = read_json(root / "meta/stats.json")
    lines = ["| column | minimum | mean | maximum |", "|---|---|---|---|"]
    for name in ("action", "next.reward", "observation.achieved_goal", "observation.desired_goal"):
        if name in stats:
            values = [_numbers(stats[name][key]) for key in ("min", "mean", "max")]
            lines.append(f"| {name} | {' | '.join(values)} |")
    return lines


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
