"""The hindsight sampler: which achieved goals of a trajectory serve as subgoals and as goals.

All index arithmetic of relabelling lives here. Two ways to cut a trajectory of T actions (and
T + 1 achieved goals) into waypoints:

``evenly``, the paper's: every T / n steps. With T = 12 and n = 4 the waypoints are 3, 6, 9 and 12.

``at_rest``, ours: where the objects have come to rest between two moves. If block 0 moves during
steps 2 to 5 and block 1 during steps 10 to 13, the waypoints are 6 and 14: stable arrangements,
each one move away from the one before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_MOVING_M = 0.0015
"""An object moves while it goes further than this in one step (37 mm/s at 25 Hz)."""
_PAUSE_STEPS = 3
"""Shorter pauses do not end a move."""
_MOVED_M = 0.01
"""Going less far than this in all is not a move."""
_RETURNED_M = 0.02
"""An object is back where it was within this distance."""


def evenly(steps: int, parts: int) -> np.ndarray:
    """Return the paper's waypoints, (parts,) indices in 1..steps, the last of them ``steps``."""
    return np.maximum(1, np.round(np.arange(1, parts + 1) * steps / parts)).astype(np.int64)


@dataclass(frozen=True)
class Move:
    """One uninterrupted move of a set of objects."""

    end: int
    """Index of the first achieved goal at rest again."""
    objects: frozenset[int]


def moves(achieved_goal: np.ndarray) -> list[Move]:
    """Cut a trajectory into moves.

    Args:
        achieved_goal: (T + 1, G), three coordinates an object in metres; where G is no multiple
            of three, all of it counts as one object.

    Returns:
        The moves in time, but for one that the end of the trajectory cuts off; consecutive moves
        of the same objects count as one, because a push that is re-aimed is still one push.
    """
    places = _places(achieved_goal)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1).max(axis=1) > _MOVING_M
    found: list[Move] = []
    for start, end in _runs(steps):
        way = np.linalg.norm(places[end] - places[start], axis=-1)
        moved = frozenset(np.flatnonzero(way > _MOVED_M).tolist())
        if end == len(steps):
            break
        if moved and found and found[-1].objects == moved:
            found.pop()
        if moved:
            found.append(Move(end, moved))
    return found


def _places(achieved_goal: np.ndarray) -> np.ndarray:
    """Return the coordinates (T + 1, objects, 3) of each object, see ``moves``."""
    count, goal_dim = achieved_goal.shape
    return achieved_goal.reshape(count, -1, goal_dim if goal_dim % 3 else 3)


def _runs(moving: np.ndarray) -> list[tuple[int, int]]:
    """Return (start, end) of the runs of True; pauses of up to _PAUSE_STEPS are bridged.

    [F F T T F T F F F F F T T F] has the runs (2, 6) and (11, 13).
    """
    runs: list[tuple[int, int]] = []
    for index in np.flatnonzero(moving).tolist():
        if runs and index - runs[-1][1] <= _PAUSE_STEPS:
            runs[-1] = (runs[-1][0], index + 1)
        else:
            runs.append((index, index + 1))
    return runs


def at_rest(achieved_goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return our waypoints and how far each may be looked beyond.

    Returns:
        (M,) indices of the waypoints in time, and (M,) for each the first waypoint after it whose
        move takes up nothing but objects that have already moved since: as a final goal, a
        waypoint at or beyond that one would lie behind a detour. It is none if the move brings an
        object back to where it was: a drawer is opened and closed again for the sake of what is
        put in between.
    """
    found = moves(achieved_goal)
    ends = np.array([0, *(move.end for move in found)], np.int64)
    places = _places(achieved_goal[ends])
    beyond = np.empty(len(found), np.int64)
    for first in range(len(found)):
        seen: frozenset[int] = frozenset()
        last = first
        while last < len(found):
            which = sorted(found[last].objects)
            way = np.linalg.norm(places[last + 1, which] - places[first, which], axis=-1)
            if seen.issuperset(which) and way.min() > _RETURNED_M:
                break
            seen |= found[last].objects
            last += 1
        beyond[first] = last
    return ends[1:], beyond


@dataclass(frozen=True)
class Waypoints:
    """The waypoints of a whole dataset, flat, and where each row of it stands among them."""

    row: np.ndarray
    """(W,) dataset rows of the waypoints, in time, episode after episode."""
    following: np.ndarray
    """(R,) for each row of the dataset the index (into ``row``) of the first waypoint after it;
    -1 where the episode has none left."""
    beyond: np.ndarray
    """(W,) index one past the last waypoint that may be a final goal, when this is the next."""

    def subgoal_and_goal(
        self, rows: np.ndarray, furthest_share: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the dataset rows of the next waypoint and of a final goal at or after it.

        Args:
            rows: (B,) rows that have a waypoint after them.
            furthest_share: of the final goals, the furthest waypoint that is no detour; the others
                are drawn uniformly among all that are none.
            rng: draws the final goals.
        """
        first = self.following[rows]
        furthest = self.beyond[first] - 1
        any_of_them = rng.integers(first, furthest + 1)
        last = np.where(rng.random(len(rows)) < furthest_share, furthest, any_of_them)
        return self.row[first], self.row[last]

    def furthest(self, rows: np.ndarray) -> np.ndarray:
        """Return the dataset rows (B,) of the furthest waypoints that are no detours."""
        return self.row[self.beyond[self.following[rows]] - 1]

    def joined(self, later: Waypoints) -> Waypoints:
        """Return these waypoints and those of rows that come after."""
        rows, count = len(self.following), len(self.row)
        moved = np.where(later.following < 0, -1, later.following + count)
        return Waypoints(
            np.concatenate([self.row, later.row + rows]),
            np.concatenate([self.following, moved]),
            np.concatenate([self.beyond, later.beyond + count]),
        )

    def without_first(self, rows: int) -> Waypoints:
        """Return the waypoints without those of the first rows, which are whole episodes."""
        gone = int(np.searchsorted(self.row, rows))
        following = self.following[rows:]
        return Waypoints(
            self.row[gone:] - rows,
            np.where(following < 0, -1, following - gone),
            self.beyond[gone:] - gone,
        )


def find_waypoints(
    achieved_goal: np.ndarray, episode_start: np.ndarray, parts: int | None
) -> Waypoints:
    """Find the waypoints of every episode.

    Args:
        achieved_goal: (R, G).
        episode_start: (E + 1,) first row of each episode.
        parts: the paper's n; None for waypoints at rest.
    """
    rows, beyond = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    following = np.full(len(achieved_goal), -1, np.int64)
    count = 0
    for start, stop in zip(episode_start[:-1], episode_start[1:], strict=True):
        if parts is None:
            local, local_beyond = at_rest(np.asarray(achieved_goal[start:stop]))
        else:
            local = evenly(stop - start - 1, parts)
            local_beyond = np.full(parts, parts)
        after = np.searchsorted(local, np.arange(stop - start), side="right")
        following[start:stop] = np.where(after < len(local), after + count, -1)
        rows.append(local + start)
        beyond.append(local_beyond + count)
        count += len(local)
    return Waypoints(np.concatenate(rows), following, np.concatenate(beyond))
