"""Where the episodes of a recording begin and end, and what their goals and rewards are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_samples import FAST, MS, PERIOD_NS, START_NS, joint_angle, rows, run

from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.writer import McapWriter


def record(path: Path, events: list[tuple[str, float, dict]], seconds: float = 2.0) -> Path:
    """Record joints and commands at 25 Hz for some seconds, with events at given seconds."""
    with McapWriter(path, FAST) as writer:
        for kind, at_s, details in events:
            writer.event(kind, START_NS + round(at_s * 1e9), **details)
        for k in range(int(seconds * 25) + 1):
            at = START_NS + k * PERIOD_NS
            angle = float(joint_angle(at))
            writer.log("/joint_states", messages.joints(["a"], [angle], at), at)
            writer.vector("/command", [k / 1000], at, role="action")
            writer.vector("/reached", [angle], at, role="observation.achieved_goal")
    return path


def test_episodes_are_cut_at_their_events(tmp_path: Path) -> None:
    source = record(
        tmp_path / "x.mcap",
        [
            ("episode_start", 0.2, {"operator": "ann"}),
            ("success", 0.5, {}),
            ("intervention_start", 0.52, {}),
            ("episode_end", 0.6, {"outcome": "success"}),
            ("episode_start", 0.8, {}),
            ("episode_end", 1.0, {"outcome": "discard"}),
            ("episode_start", 1.2, {}),
            ("episode_start", 1.4, {}),
            ("intervention_start", 1.48, {}),
            ("intervention_end", 1.56, {}),
        ],
    )
    episodes, report = run(source, tmp_path / "d")
    assert [len(e) for e in episodes] == [10, 5, 15]
    assert [e.info["outcome"] for e in episodes] == ["success", "", ""]
    assert [e.info["complete"] for e in episodes] == [True, False, False]
    assert [bool(e.done[-1]) for e in episodes] == [True, False, False]
    assert [bool(e.truncated[-1]) for e in episodes] == [False, True, True]
    assert episodes[0].info["operator"] == "ann" and episodes[0].info["success_mark"] is True
    assert episodes[0].observation[0, 0] == pytest.approx(0.2)
    assert any("discarded" in line for line in report.lines)
    # An intervention ends with the first action that is not the human's, or with the episode.
    held = np.split(rows(tmp_path / "d")["intervention"], [10, 15])
    assert [np.flatnonzero(h).tolist() for h in held] == [[8, 9], [], [2, 3]]


def test_without_events_the_whole_recording_is_one_episode(tmp_path: Path) -> None:
    (episode,), _ = run(record(tmp_path / "x.mcap", []), tmp_path / "d")
    assert len(episode) == 50 and episode.info["goal"] == "last achieved"
    assert episode.success[-1] and episode.desired_goal.tolist() == [2.0]


def test_the_reward_is_zero_exactly_where_the_goal_error_is_within_epsilon(tmp_path: Path) -> None:
    (episode,), _ = run(record(tmp_path / "x.mcap", []), tmp_path / "d", epsilon_m=0.1)
    near = np.abs(episode.achieved_goal[:, 0] - 2.0) <= np.float32(0.1)
    assert np.array_equal(episode.success, near)
    assert np.array_equal(episode.reward, np.where(near[1:], 0.0, -1.0))


def test_a_goal_that_changes_starts_a_new_episode(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "y.mcap", FAST) as writer:
        for k in range(26):
            at = START_NS + k * PERIOD_NS
            writer.log("/joint_states", messages.joints(["a"], [k], at), at)
            writer.vector("/command", [0.0], at, role="action")
            writer.vector("/reached", [k], at, role="observation.achieved_goal")
            if k in (0, 10):
                writer.vector("/goal", [k], at, role="observation.desired_goal")
    episodes, _ = run(tmp_path / "y.mcap", tmp_path / "d")
    assert [e.desired_goal.tolist() for e in episodes] == [[0.0], [10.0]]
    assert [len(e) for e in episodes] == [10, 15]
    # Both hold the observation at which the goal changed.
    assert episodes[0].observation[-1, 0] == episodes[1].observation[0, 0] == 10
    assert not episodes[0].done.any() and episodes[0].truncated[-1]


def test_a_goal_said_an_instant_after_the_first_command_is_that_of_the_first_row(
    tmp_path: Path,
) -> None:
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        for episode in range(2):
            start = START_NS + episode * 2_000_000_000
            writer.event("episode_start", start)
            for k in range(10):
                at = start + k * PERIOD_NS
                writer.log("/joint_states", messages.joints(["a"], [k], at), at)
                writer.vector("/reached", [k], at, role="observation.achieved_goal")
                writer.vector("/command", [0.0], at, role="action")
                if k == 0:
                    late = at + 3 * MS
                    writer.vector("/goal", [episode], late, role="observation.desired_goal")
            writer.event("episode_end", at)
    episodes, _ = run(tmp_path / "x.mcap", tmp_path / "d")
    assert [(len(e), e.desired_goal.tolist()) for e in episodes] == [(9, [0.0]), (9, [1.0])]


def test_a_jittering_control_loop_loses_and_doubles_no_command(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with McapWriter(tmp_path / "x.mcap", FAST) as writer:
        writer.event("episode_start", START_NS - MS)
        for k in range(101):
            seen = START_NS + k * PERIOD_NS + int(rng.uniform(-5, 5) * MS) * (k > 0)
            writer.vector("/state", [k], seen, role="observation.state")
            writer.vector("/reached", [k], seen, role="observation.achieved_goal")
            if k < 100:
                writer.vector("/command", [k / 100], seen + 6 * MS, role="action")
        writer.event("episode_end", seen + MS)
    (episode,), _ = run(tmp_path / "x.mcap", tmp_path / "d")
    np.testing.assert_allclose(episode.action[:, 0], np.arange(100) / 100, atol=1e-7)
    assert len(episode) == 100
