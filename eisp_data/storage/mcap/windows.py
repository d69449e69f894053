"""Where the episodes of a recording begin and end: by its events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from eisp_data.storage.mcap.decode import Event
from eisp_data.storage.mcap.messages import EVENT_KINDS, OUTCOMES


@dataclass
class Window:
    """One episode's stretch of the recording."""

    start_ns: int
    end_ns: int
    outcome: str = ""
    """What ``episode_end`` said, empty if it said nothing or never came."""
    complete: bool = True
    """False if the recording stopped, or the next episode began, before ``episode_end``."""
    ended_by_source: bool = False
    """It ends where the first source stops, for no event ended it."""
    marked_success: bool = False
    """Somebody marked a success during the episode."""
    interventions: list[tuple[int, int]] = field(default_factory=list)
    """(from, to) of the times at which a human held the controls."""
    details: dict[str, str] = field(default_factory=dict)
    """What ``episode_start`` said: policy, operator, level."""


def cut(events: Sequence[Event], first_ns: int, last_ns: int) -> list[Window]:
    """Return the episodes between ``episode_start`` and ``episode_end`` events, in order.

    Without any ``episode_start`` the whole recording, from ``first_ns`` to ``last_ns``, is one.
    Episodes that ended with the outcome ``discard`` are in the list too.
    """
    windows: list[Window] = []
    open_window: Window | None = None
    if not started(events):
        open_window = Window(first_ns, last_ns)
        windows.append(open_window)
    held_since: int | None = None
    for event in events:
        at = event.time_ns or 0
        if event.kind == "episode_start":
            if open_window is not None:
                _close(open_window, at, held_since)
                open_window.complete = False
            open_window, held_since = Window(at, last_ns, details=dict(event.details)), None
            windows.append(open_window)
        elif open_window is None:
            continue
        elif event.kind == "episode_end":
            open_window.outcome = event.details.get("outcome", "")
            _close(open_window, at, held_since)
            open_window = None
        elif event.kind == "success":
            open_window.marked_success = True
        elif event.kind == "intervention_start":
            held_since = at
        elif event.kind == "intervention_end" and held_since is not None:
            open_window.interventions.append((held_since, at))
            held_since = None
    if open_window is not None:
        _close(open_window, last_ns, held_since)
        open_window.complete, open_window.ended_by_source = not started(events), True
    return windows


def _close(window: Window, at: int, held_since: int | None) -> None:
    window.end_ns = at
    if held_since is not None:
        window.interventions.append((held_since, at))


def started(events: Sequence[Event]) -> int:
    """Return how many episodes the events begin."""
    return sum(event.kind == "episode_start" for event in events)


def unknown_words(events: Sequence[Event]) -> str:
    """Return what the events say that means nothing here, and what would; empty if nothing."""
    kinds = {event.kind for event in events} - set(EVENT_KINDS)
    ends = [event.details for event in events if event.kind == "episode_end"]
    outcomes = {details.get("outcome", "") for details in ends} - {"", *OUTCOMES}
    unknown = [*sorted(map(repr, kinds)), *sorted(f"'outcome={word}'" for word in outcomes)]
    if not unknown:
        return ""
    return (
        f"its events say {', '.join(unknown)}, which mean nothing here; known are "
        f"{', '.join(EVENT_KINDS)}, and outcome={'|'.join(OUTCOMES)} after episode_end"
    )


def dropped(events: Sequence[Event]) -> dict[str, int]:
    """Return topic to messages that the recorder said it dropped."""
    counts: dict[str, int] = {}
    for event in events:
        if event.kind == "dropped" and event.details.get("count", "").isdigit():
            topic = event.details.get("topic", "")
            counts[topic] = counts.get(topic, 0) + int(event.details["count"])
    return counts
