"""``eisp-data push`` and ``eisp-data pull``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True)
class Push:
    """Options of ``eisp-data push``."""

    path: tyro.conf.Positional[Path]
    """A dataset, a policy (``pretrained_model``) or MCAP recordings."""
    repo_id: str
    """Repository as owner/name; recordings go to owner/name-raw."""
    license: str = "apache-2.0"
    """Licence on the card, as Hubs name it."""
    citation: Path | None = None
    """BibTeX file for the card."""
    private: bool = False
    """Make the repository private if it is new."""
    dry_run: bool = False
    """Only show exactly what would go; no network is used."""


@dataclass(frozen=True)
class Pull:
    """Options of ``eisp-data pull``."""

    repo_id: tyro.conf.Positional[str]
    """Repository as owner/name."""
    to: Path
    """Folder to make."""
    repo_type: Literal["dataset", "model"] = "dataset"
    """A policy is a model."""
    revision: str | None = None
    """Branch, tag or commit; the default branch if left out."""


def push(options: tyro.conf.OmitArgPrefixes[Push]) -> None:
    """Check a dataset, a policy or recordings and send them to a Hub in one commit."""
    from eisp_data import hub
    from eisp_data.storage.card import CITATION

    citation = options.citation.read_text() if options.citation else CITATION
    plan = hub.plan_push(options.path, options.repo_id, options.license, citation)
    if options.dry_run:
        print("\n".join(["would send", *plan.lines()]))
        return
    print(f"sent {len(plan.items)} files: {hub.push(plan, options.private)}")


def pull(options: tyro.conf.OmitArgPrefixes[Pull]) -> None:
    """Fetch a dataset, recordings or a policy: verified and whole, or not at all."""
    from eisp_data import hub

    size = hub.pull(options.repo_id, options.to, options.repo_type, options.revision)
    print(f"{size} bytes in {options.to}")
