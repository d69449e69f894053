"""Metrics of a run: one JSON object a line, and TensorBoard."""

from __future__ import annotations

import json
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from eisp_data.errors import DataError
from eisp_data.storage.files import replace_atomically


class Speeds:
    """How fast the parts of a run that take turns are, each while it is its turn."""

    def __init__(self) -> None:
        self._count: defaultdict[str, int] = defaultdict(int)
        self._spent_s: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def measured(self, what: str, count: int) -> Iterator[None]:
        """Count so many of something that are done in the ``with``."""
        start = time.perf_counter()
        yield
        self._count[what] += count
        self._spent_s[what] += time.perf_counter() - start

    def taken(self) -> dict[str, float]:
        """Return ``<what>_per_s`` of each since the last call."""
        rates = {f"{what}_per_s": n / self._spent_s[what] for what, n in self._count.items()}
        self._count.clear()
        self._spent_s.clear()
        return rates


class MetricsLog:
    """Appends to ``metrics.jsonl`` and to TensorBoard's event files beside it.

    Args:
        run: the run's folder.
        stage: ``pretrain`` or ``finetune``; other stages' lines in the file stay as they are.
        done: drop what this stage has logged after this many updates: a resumed run does it again;
            -1 drops all.
    """

    def __init__(self, run: Path, stage: str, done: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._stage = stage
        path = run / "metrics.jsonl"
        lines = path.read_text().splitlines() if path.exists() else []
        kept = "".join(f"{line}\n" for line in lines if self._keeps(line, done))
        replace_atomically(path, lambda draft: draft.write_text(kept))
        self._file = path.open("a")
        self._board = SummaryWriter(str(run), purge_step=done + 1)

    def _keeps(self, line: str, done: int) -> bool:
        try:
            entry = json.loads(line)
        except ValueError:  # a line cut off by a kill
            return False
        return entry["stage"] != self._stage or entry["updates"] <= done

    def write(self, updates: int, env_steps: int, wall_s: float, values: Mapping[str, Any]) -> None:
        """Log the values at this many updates and environment steps of the stage.

        Raises:
            DataError: a loss is not a number; the checkpoints before are of use.
        """
        numbers = {name: float(value) for name, value in values.items()}
        for name, value in numbers.items():
            if name.startswith("train/") and not math.isfinite(value):
                raise DataError(
                    f"{self._stage}: {name} is {value} after {updates} updates: learning has "
                    "diverged; take lower learning rates"
                )
        head = {
            "stage": self._stage,
            "updates": updates,
            "env_steps": env_steps,
            "wall_s": round(wall_s, 3),
        }
        self._file.write(json.dumps(head | numbers) + "\n")
        self._file.flush()
        for name, value in numbers.items():
            self._board.add_scalar(f"{self._stage}/{name}", value, updates)

    def close(self) -> None:
        """Write out what is pending."""
        self._file.close()
        self._board.close()
