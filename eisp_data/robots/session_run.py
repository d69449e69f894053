"""A whole session: connect, run episodes, record them, and leave a standing robot and a closed log.

Used by ``eisp-record`` and ``eisp-deploy`` alike; they differ in who decides.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from eisp_data.robots.loop import Timing, priority, runs_by_itself
from eisp_data.robots.record_controllers import Controller
from eisp_data.robots.session import Ended, Session, Watch, ignore
from eisp_data.robots.session_cell import Cell, CellConfig, open_cell
from eisp_data.robots.session_log import SessionLog
from eisp_data.robots.session_status import Status, StopSignal, stop_signals
from eisp_data.storage.mcap.writer import WriterStats

_BETWEEN_S = 0.1
_MOST_BYTES = 4096
"""Of a line in a terminal."""


@dataclass(frozen=True)
class Plan:
    """What is to be done in a session."""

    output: Path
    """The recording; it must not exist yet."""
    episodes: int
    episode_s: float
    """The longest that an episode may last."""
    pause_s: float
    """Between two episodes a human has so long to set the table, or presses enter before."""
    metadata: dict[str, str]
    first: int = 0
    """Number of the first episode, where earlier ones were done before."""
    images: bool = True
    """Record the cameras' images."""


@dataclass
class Report:
    """What became of a session."""

    output: Path
    episodes: list[Ended] = field(default_factory=list)
    goals: list[np.ndarray] = field(default_factory=list)
    timing: Timing | None = None
    simulated: bool = False
    """The robot's clock stood still while nobody asked: its timing says nothing."""
    real_time: bool = False
    """The system let the loop run before all ordinary processes."""
    stats: WriterStats | None = None
    lost_frames: dict[str, int] = field(default_factory=dict)
    refusals: dict[str, int] = field(default_factory=dict)
    """How often the safety filter changed a command, by reason."""
    stopped_by: signal.Signals | None = None
    """The signal with which somebody wanted an end to it."""

    @property
    def exit_status(self) -> int:
        """What the command exits with: as a shell does after the signal, or the next one would move
        a robot that somebody has just stopped."""
        return 0 if self.stopped_by is None else 128 + self.stopped_by

    def lines(self) -> list[str]:
        """Return what is to be said at the end; of each episode it was said when it ended."""
        found = []
        if self.timing is not None:
            scheduled = (
                "on simulated time"
                if self.simulated
                else ("with real-time priority" if self.real_time else "without real-time priority")
            )
            found.append(f"control loop ({scheduled}): {self.timing}")
        found += [f"camera {name}: {n} images lost" for name, n in self.lost_frames.items() if n]
        if self.refusals:
            said = ", ".join(f"{reason} {n} times" for reason, n in self.refusals.items())
            found.append(f"commands changed by the safety filter: {said}")
        if self.stats is not None:
            written, dropped = sum(self.stats.written.values()), sum(self.stats.dropped.values())
            found.append(f"{self.output}: {written} messages, {dropped} dropped")
        if self.stopped_by is not None:
            found.append(f"stopped by {self.stopped_by.name}")
        return found


def run_session(
    config: CellConfig,
    plan: Plan,
    make_controller: Callable[[Cell], Controller],
    report: Report,
    watch: Watch = ignore,
    after: Callable[[int, Cell, np.ndarray, Ended], None] = lambda number, cell, goal, ended: None,
) -> None:
    """Run a session to its end, to Ctrl-C, or to an error.

    Args:
        config: which robot.
        plan: what to do.
        make_controller: called once, with the connected cell.
        report: where what happened is noted, also where it ends in an error.
        watch: see ``Session.run_episode``.
        after: called after each episode with its number, the cell, the goal, and how it ended.

    Raises:
        EispError: something failed; the robot stands, the recording is closed and has its index.
    """
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_stoppable(report))
        cell = stack.enter_context(open_cell(config))
        report.simulated = not runs_by_itself(cell.robot)
        # Whatever takes long is done before anything moves.
        controller = make_controller(cell)
        goal = cell.set_table(config.seed + plan.first, config.goal)
        if not report.simulated:
            report.real_time = stack.enter_context(priority())
        log = stack.enter_context(_recording(cell, plan, report))
        session = Session(cell.robot, log, cell.servo(), stop)
        report.timing = session.ticks.timing()
        status = stack.enter_context(_status(session, report))
        session.say = status.say
        try:
            for number in range(plan.first, plan.first + plan.episodes):
                if number > plan.first:
                    _pause(cell, session, plan, status, stop)
                    goal = cell.set_table(config.seed + number, config.goal)
                if stop.given:
                    break
                report.goals.append(goal)
                most = round(plan.episode_s * cell.robot.control_hz)
                ended = session.run_episode(
                    controller, cell.eyes(), goal, most, config.seed + number, watch
                )
                report.episodes.append(ended)
                status.say(f"episode {number}: {ended}")
                after(number, cell, goal, ended)
        finally:
            report.timing = session.ticks.timing()
            report.lost_frames = dict(log.lost_frames)
            report.refusals = dict(cell.robot.filter.refusals)


@contextlib.contextmanager
def _stoppable(report: Report) -> Iterator[StopSignal]:
    with stop_signals() as stop:
        try:
            yield stop
        finally:
            report.stopped_by = stop.given


@contextlib.contextmanager
def _recording(cell: Cell, plan: Plan, report: Report) -> Iterator[SessionLog]:
    log = SessionLog(cell.robot, plan.output, plan.metadata, images=plan.images)
    try:
        yield log
    finally:
        report.stats = log.close()


@contextlib.contextmanager
def _status(session: Session, report: Report) -> Iterator[Status]:
    def line() -> str:
        timing = session.ticks.timing()
        late = "" if report.simulated else f" | late {timing.late_p99_ms:.1f} ms (99%)"
        return f"{session.doing}{late}, {timing.dropped} dropped"

    status = Status(line)
    try:
        yield status
    finally:
        status.close()


def _pause(cell: Cell, session: Session, plan: Plan, status: Status, stop: StopSignal) -> None:
    """Wait while a human sets the table; a twin's sets itself."""
    if cell.has_referee:
        return
    # An enter from before does not count. Flushing the terminal would stop a background process.
    while _typed(0.0):
        pass
    status.say(f"set the table, then press enter (it goes on by itself after {plan.pause_s:g} s)")
    session.doing = "waiting for the table to be set"
    until = time.monotonic() + plan.pause_s
    while time.monotonic() < until and not stop.given:
        if b"\n" in (_typed(_BETWEEN_S) or b""):
            return


def _typed(wait_s: float) -> bytes | None:
    """Return what somebody types meanwhile, empty at an end of input; None if there is nothing."""
    if not sys.stdin.isatty():
        time.sleep(wait_s)
        return None
    ready = select.select([sys.stdin], [], [], wait_s)[0]
    return os.read(sys.stdin.fileno(), _MOST_BYTES) if ready else None
