"""The card of a dataset or a policy: its README on a Hub, written from what it says of itself."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from eisp_data.storage.files import read_json
from eisp_data.storage.summary import summary

CITATION = """@misc{eisp,
  title = {Explicit-Implicit Subgoal Planning for Long-Horizon Tasks},
  note = {Collected with the EISP toolkit}
}"""
CARD = "README.md"
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
    sections = {
        "Task and shapes": _table(
            {k: facts[k] for k in facts if k not in ("recipe", "fingerprint")}
        ),
        "How it was collected": _json(facts["recipe"]),
        "Statistics": _statistics(root),
        "Use": [
            "It is a LeRobot v3.0 dataset. The text column `eisp.episode` holds, in the first row "
            "of each episode, what v3 has no place for: the last observation, the seed, the "
            "simulator state; `eisp_data.storage.lerobot.read_episodes` returns whole episodes."
        ],
    }
    opening = [
        f"# {facts['task']}: {facts['instruction']}",
        "",
        f"![Preview]({preview})",
        "",
        f"{episodes} episodes, {facts['frames']} frames at {facts['rate_hz']} Hz "
        f"({facts['duration_min']} minutes). {facts['success_at_last']} of them "
        f"({share:.1%}) succeed at the last observation, {facts['success_at_any']} at any.",
    ]
    return _card(header, opening, sections, citation)


def policy_card(folder: Path, license_name: str, citation: str = CITATION) -> str:
    """Return the card of a policy: ``folder`` holds its ``config.json``; see ``dataset_card``."""
    config = read_json(folder / "config.json")
    agent = config.get("agent") if isinstance(config, dict) else None
    task = str(agent.get("task", "")) if isinstance(agent, dict) else ""
    header = {
        "license": license_name,
        "pipeline_tag": "robotics",
        "tags": [tag for tag in ("EISP", task) if tag],
    }
    opening = [
        f"# {task or 'Goal-conditioned policy'}",
        "",
        "A subgoal generator and the goal-conditioned policy that reaches its subgoals one by one.",
    ]
    sections = {
        "Use": [
            "`eisp-data pull OWNER/NAME --repo-type model --to policy`, then "
            "`eisp-eval --policy.path policy`."
        ],
        "Configuration": _json(config),
    }
    return _card(header, opening, sections, citation)


def _card(
    header: Mapping[str, Any],
    opening: Sequence[str],
    sections: Mapping[str, Sequence[str]],
    citation: str,
) -> str:
    """Return a card: the metadata block that Hubs read, opening, sections, licence, citation."""
    ending = [f"Licence: {header['license']}", "", "```bibtex", citation, "```"]
    lines = ["---", yaml.safe_dump(dict(header), sort_keys=False).strip(), "---", "", *opening, ""]
    for title, body in {**sections, "Licence and citation": ending}.items():
        lines += [f"## {title}", "", *body, ""]
    return "\n".join(lines)


def _json(value: Any) -> list[str]:
    return ["```json", json.dumps(value, indent=2, ensure_ascii=False), "```"]


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
