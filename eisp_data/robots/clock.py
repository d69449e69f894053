"""A device's clock put on this machine's."""

from __future__ import annotations

import math

_DRIFT = 1e-4
"""How much faster than ours a device's clock may run."""


class HardwareClock:
    """Learns a device's offset: nothing arrives before it was stamped, and some of it at once."""

    def __init__(self) -> None:
        self._offset_s = math.inf
        self._before_s = 0.0

    def to_host_s(self, device_s: float, arrived_s: float) -> float:
        """Return a device's stamp on the clock of the arrivals, which is ``time.monotonic``."""
        drifted = self._offset_s + _DRIFT * max(0.0, arrived_s - self._before_s)
        self._offset_s, self._before_s = min(drifted, arrived_s - device_s), arrived_s
        return device_s + self._offset_s
