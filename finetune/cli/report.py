"""``eisp-report``: one self-contained page on a run."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from eisp_data.cli.run import run


@dataclass(frozen=True)
class ReportConfig:
    """Which run, and where the page goes."""

    run_dir: Path
    """Folder of the run."""
    output: Path | None = None
    """The page; report.html in the run if left out."""


@dataclass(frozen=True)
class VqVaeReportConfig:
    """Which VQ-VAE, and whose subgoals."""

    path: tyro.conf.Positional[Path]
    """The run of eisp-vqvae train."""
    policy: Path | None = None
    """A policy of an image task, to draw its subgoals along an episode."""
    seed: int = 1000
    """Of the episode."""
    output: Path | None = None
    """The page; report.html in the run if left out."""


def main() -> None:
    """Run ``eisp-report``."""
    words = sys.argv[1:]
    if words[:1] == ["vqvae"]:
        run(report_vqvae, words[1:], prog="eisp-report vqvae")
    else:
        run(report, prog="eisp-report")


def report_vqvae(config: tyro.conf.OmitArgPrefixes[VqVaeReportConfig]) -> None:
    """Make one page of a VQ-VAE: loss, images, and the subgoals of a policy; print where it is."""
    from finetune.vqvae_report import write_vqvae_report

    print(f"report: {write_vqvae_report(config.path, config.policy, config.seed, config.output)}")


def report(config: ReportConfig) -> None:
    """Make one page of a run, with results, learning curves and a film; print where it is.

    eisp-report vqvae RUN makes one of a VQ-VAE.
    """
    from finetune.report import read_run, write_report
    from finetune.results import results_text

    path = write_report(config.run_dir, config.output)
    found = read_run(config.run_dir)
    if found.before or found.after:
        print(results_text(found.before, found.after))
    else:
        print(f"no evaluation: eisp-eval --json > {config.run_dir / 'evaluation_after.json'}")
    print(f"report: {path}")


if __name__ == "__main__":
    main()
