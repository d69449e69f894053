"""What the numbers of a dataset look like: stuck channels, outliers, lag, success, extremes."""

from __future__ import annotations

import numpy as np

from eisp_data.storage.checks import Check
from eisp_data.storage.reader import Block
from eisp_data.storage.rows import as_table
from eisp_data.storage.schema import REPEATED
from eisp_data.storage.spec import DatasetSpec

STUCK_STEPS = 25
"""Steps without any change after which a channel that moves in other episodes is stuck."""
MOST_STEPS = 20_000
"""Rows from which the lag is estimated."""
LARGEST_LAG = 10
SUSPICIOUS_LAG = 3
"""Steps between an action and its effect; more smells of clocks that disagree."""
CLEAR_CORRELATION = 0.3
COMMANDED = ("observation.state", "action")
"""Columns that move in every episode."""
MEASURED = ("observation.state", "observation.environment_state", "observation.achieved_goal")
FAR_WIDTHS = 100
"""A value is far out if it is this many widths of its usual range beyond that range."""
LEAST_WIDTH = 0.1
"""The least that counts as the width of a range, so that no turn of a quaternion is far out."""


class Collected:
    """Gathers, block by block, what the checks of the signals need; memory is bounded."""

    def __init__(self, spec: DatasetSpec) -> None:
        self._fps = spec.fps
        self.rows = 0
        self.extremes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        """Column to its (D,) minimum and maximum."""
        self.repeated = {name: 0 for name in spec.extras if name.startswith(REPEATED)}
        """Column of a recording's camera to how many rows repeat a frame."""
        self._ranges: dict[str, list[np.ndarray]] = {name: [] for name in (*MEASURED, "action")}
        """Column to (2, D) minimum and maximum of each episode."""
        self._lengths: list[int] = []
        self._pairs: list[tuple[np.ndarray, np.ndarray]] = []
        self._paired = 0
        self._last: list[bool] = []
        self._any: list[bool] = []

    def add(self, block: Block) -> None:
        """Look at the rows of a block."""
        self.rows += int(block.starts[-1])
        for name, values in block.columns.items():
            table = as_table(values)
            low, high = table.min(axis=0), table.max(axis=0)
            if name in self.extremes:
                low = np.minimum(low, self.extremes[name][0])
                high = np.maximum(high, self.extremes[name][1])
            self.extremes[name] = (low, high)
            if name in self.repeated:
                self.repeated[name] += int(np.count_nonzero(table > 0))
        for offset, start in enumerate(block.starts[:-1]):
            rows = slice(int(start), int(block.starts[offset + 1]))
            for name, ranges in self._ranges.items():
                if name in block.columns:
                    table = as_table(block.columns[name][rows])
                    ranges.append(np.stack([table.min(axis=0), table.max(axis=0)]))
            self._lengths.append(rows.stop - rows.start)
            success = block.columns["next.success"][rows]
            self._last.append(bool(success[-1]))
            self._any.append(bool(success.any() or block.sidecars[offset].first_success))
            if self._paired < MOST_STEPS and rows.stop - rows.start > 2 * LARGEST_LAG:
                states = as_table(block.columns["observation.state"][rows])
                actions = as_table(block.columns["action"][rows])
                self._pairs.append((states.astype(np.float64), actions.astype(np.float64)))
                self._paired += len(states)

    def stuck(self) -> Check:
        """Find channels that move in most episodes and not at all in a long one."""
        found = []
        for name in COMMANDED:
            low, high = np.stack(self._ranges[name], axis=1)
            moved = high > low
            usual = moved.mean(axis=0) > 0.5
            for episode, component in np.argwhere(~moved & usual):
                if self._lengths[episode] >= STUCK_STEPS:
                    found.append(f"{name}[{component}] in episode {episode}")
        return Check("stuck channels", True, _first(found), warning=bool(found))

    def outliers(self) -> Check:
        """Find episodes in which something is far from where it is in most others.

        One object that falls without end spoils the standardisation of the whole dataset.
        """
        found = []
        for name in MEASURED:
            if not self._ranges[name]:
                continue
            low, high = np.stack(self._ranges[name], axis=1).astype(np.float64)
            usual_low, usual_high = np.median(low, axis=0), np.median(high, axis=0)
            reach = FAR_WIDTHS * np.maximum(usual_high - usual_low, LEAST_WIDTH)
            far = np.where(usual_low - low > high - usual_high, low, high)
            beyond = np.maximum(usual_low - low, high - usual_high) > reach
            found += [
                f"{name}[{component}] is {far[episode, component]:.4g} in episode {episode}, in "
                f"most {usual_low[component]:.3g} to {usual_high[component]:.3g}"
                for episode, component in np.argwhere(beyond)
            ]
        return Check("outliers", True, _first(found), warning=bool(found))

    def repeats(self) -> Check:
        """Count the rows that repeat a camera's frame because the next one was lost."""
        found = [
            f"{name.removeprefix(REPEATED)} {count} of {self.rows} rows ({count / self.rows:.1%})"
            for name, count in self.repeated.items()
            if count
        ]
        return Check("repeated frames", True, ", ".join(found) or "none", warning=bool(found))

    def lag(self) -> Check:
        """Estimate how many steps after an action the robot's state shows it.

        The change of every state from row to row is correlated with every action some steps
        before; the lag of the clearest pair counts.
        """
        best, best_lag = 0.0, 0
        for lag in range(LARGEST_LAG + 1):
            strength = _correlation(self._pairs, lag)
            if strength > best + 1e-9:
                best, best_lag = strength, lag
        if best < CLEAR_CORRELATION:
            return Check("action lag", True, f"not clear (correlation {best:.2f} at most)")
        late = best_lag > SUSPICIOUS_LAG
        text = f"{best_lag} step(s), {1000 * best_lag / self._fps:.0f} ms (correlation {best:.2f})"
        return Check("action lag", True, text, warning=late)

    def success(self) -> str:
        """Return the shares of episodes that succeed at the last and at any observation."""
        count = len(self._last)
        at_last, at_any = sum(self._last), sum(self._any)
        return (
            f"{at_last} of {count} at the last observation ({at_last / count:.1%}), "
            f"{at_any} at any ({at_any / count:.1%})"
        )


def _first(found: list[str]) -> str:
    """Return the first of what was found as one text."""
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return ", ".join(found[:3]) + more or "none"


def _correlation(pairs: list[tuple[np.ndarray, np.ndarray]], lag: int) -> float:
    """Return the largest |correlation| of a state's change and an action ``lag`` steps before.

    ``state[t + 1] - state[t]`` is the change that action t makes when there is no lag.
    """
    changes, actions = [], []
    for state, action in pairs:
        change = np.diff(state, axis=0)
        changes.append(change[lag:])
        actions.append(action[: len(change) - lag])
    if not changes:
        return 0.0
    x, y = np.concatenate(changes), np.concatenate(actions)
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    scale = np.sqrt(np.outer((x**2).sum(axis=0), (y**2).sum(axis=0)))
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.nan_to_num(np.abs(x.T @ y) / scale, posinf=0.0).max())
