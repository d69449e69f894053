"""The control loop's clock: absolute deadlines, and a record of how well they were kept."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from eisp_data.robots.robot import Robot

POLLS = 4
"""How often per control period new readings and images are asked for: 100 times a second at 25 Hz,
so that a camera of 30 or 60 images a second loses none to a slower loop."""
_NANOSECONDS = 1_000_000_000
_MOMENT_S = 0.002
_SWITCH_S = 0.0005


@dataclass(frozen=True)
class Timing:
    """How well the loop kept its deadlines, on the robot's clock."""

    rate_hz: float
    ticks: int
    dropped: int
    """Deadlines that passed altogether while an earlier tick was still at work."""
    late_median_ms: float
    """How long after its deadline a tick began."""
    late_p99_ms: float
    late_max_ms: float
    load: float
    """Runnable processes on the machine over the last minute, for each core."""

    def __str__(self) -> str:
        return (
            f"{self.ticks} ticks at {self.rate_hz:g} Hz, {self.dropped} dropped; begun late by "
            f"{self.late_median_ms:.2f} ms (median), {self.late_p99_ms:.2f} ms (99%), "
            f"{self.late_max_ms:.2f} ms (most); machine load {self.load:.1f} per core"
        )


class Ticks:
    """Deadlines at a fixed rate, counted from the first and never from the last tick.

    A tick that takes too long makes the next ones late, or skips them; they are not made up for,
    because a robot that is sent three commands at once jerks.
    """

    def __init__(self, robot: Robot, rate_hz: float) -> None:
        self._robot, self._rate_hz = robot, rate_hz
        self._period_ns = round(_NANOSECONDS / rate_hz)
        self._late_s: list[float] = []
        self._dropped = 0

    def run(self, poll: Callable[[int], None]) -> Iterator[int]:
        """Yield each deadline in ns of the robot's clock; the caller ends the loop by leaving it.

        Args:
            poll: called with 0 right before each tick, then with 1 to POLLS - 1, evenly spaced
                until the next; those for which it is too late are left out.
        """
        robot, period = self._robot, self._period_ns
        # Whole nanoseconds: rows of a dataset are cut out of the log at exactly this rate.
        deadline = round(robot.now_s() * _NANOSECONDS)
        while True:
            late_ns = round(robot.now_s() * _NANOSECONDS) - deadline
            self._late_s.append(late_ns / _NANOSECONDS)
            poll(0)
            yield deadline
            for part in range(1, POLLS):
                at = (deadline + part * period // POLLS) / _NANOSECONDS
                if robot.now_s() <= at:
                    robot.wait_until(at)
                    poll(part)
            deadline += period
            behind = round(robot.now_s() * _NANOSECONDS) - deadline
            if behind >= period:
                self._dropped += behind // period
                deadline += behind // period * period
            robot.wait_until(deadline / _NANOSECONDS)

    def timing(self) -> Timing:
        """Return how well the deadlines were kept so far."""
        # A simulated clock that stands still between two calls may round to just before.
        late_ms = 1000 * np.maximum(self._late_s or [0.0], 0.0)
        median, p99 = np.percentile(late_ms, [50, 99])
        return Timing(
            rate_hz=self._rate_hz,
            ticks=len(self._late_s),
            dropped=self._dropped,
            late_median_ms=float(median),
            late_p99_ms=float(p99),
            late_max_ms=float(late_ms.max()),
            load=os.getloadavg()[0] / (os.cpu_count() or 1),
        )


def runs_by_itself(robot: Robot) -> bool:
    """Return whether the connected robot's clock goes on while nobody asks: not in a simulation."""
    before = robot.now_s()
    time.sleep(_MOMENT_S)
    return robot.now_s() > before


@contextlib.contextmanager
def priority() -> Iterator[bool]:
    """Run before all ordinary processes, with the threads that are started meanwhile.

    Without it a busy machine begins ticks some 10 ms late now and then. Yields whether the system
    granted it; it takes ``CAP_SYS_NICE``, or an ``rtprio`` limit as in a robot vendor's set-up.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield False
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        yield False
        return
    # A thread that wants the interpreter waits this long for one that does not let go of it.
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield True
    finally:
        sys.setswitchinterval(switch_s)
        os.sched_setscheduler(0, *before)
