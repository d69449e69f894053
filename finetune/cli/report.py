"""``eisp-report``: one self-contained page on a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from eisp_data.cli.run import run


@dataclass(frozen=True)
class ReportConfig:
    """Which run, and where the page goes."""

    run_dir: Path
    """Folder of the run."""
    output: Path | None = None
    """The page; report.html in the run if left out."""


def main() -> None:
    """Run ``eisp-report``."""
    run(report, prog="eisp-report")


def report(config: ReportConfig) -> None:
    """Make one page of a run, with results, learning curves and a film; print where it is."""
    from finetune.report import read_run, write_report
    from finetune.results import results_text

    path = write_report(config.run_dir, config.output)
    found = read_run(config.run_dir)
    if found.before or found.after:
        print(results_text(found.before, found.after))
    print(f"report: {path}")


if __name__ == "__main__":
    main()
