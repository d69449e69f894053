"""``eisp-record``: a session with a robot as an MCAP recording."""

from __future__ import annotations

import sys

from eisp_data.cli.run import run
from eisp_data.robots.record import RecordConfig


def main() -> None:
    """Run ``eisp-record``."""
    run(_command, prog="eisp-record", config_file=True)


def _command(config: RecordConfig) -> None:
    """Record a session with a robot; ``eisp-data convert`` makes a dataset of the recording."""
    from eisp_data.robots.record import record

    sys.exit(record(config).exit_status)


if __name__ == "__main__":
    main()
