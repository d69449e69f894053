"""The result of one named check, of a dataset or of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Check(NamedTuple):
    """One check: what was looked at, whether it is as it should be, and a line of detail."""

    name: str
    passed: bool
    detail: str
    warning: bool = False
    """It is only suspicious; ``passed`` stays True."""

    @property
    def verdict(self) -> str:
        """Return ``ok``, ``warn`` or ``FAIL``."""
        return "FAIL" if not self.passed else "warn" if self.warning else "ok"


def table(checks: Sequence[Check]) -> list[str]:
    """Return the checks as lines of aligned text."""
    width = max((len(check.name) for check in checks), default=0)
    return [f"{c.verdict:5}{c.name:{width}}  {c.detail}" for c in checks]
