"""The way of the README, line by line: from a ROS 2 bag to a pretrained generator."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from eisp_data.cli.data import main as eisp_data
from eisp_data.collect import collect
from eisp_data.errors import ConfigError
from eisp_data.policies.registry import DEMONSTRATOR, SCRIPTS
from eisp_data.sim.offscreen import open_gl
from eisp_data.storage.lerobot import read_episodes
from eisp_data.tasks.registry import get_task

DOCS = Path(__file__).parents[4] / "docs"
EPISODES = 3
SEED = 1_000_000


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that runs a command with these words."""

    def run(main: Callable[[], None], *words: object) -> None:
        monkeypatch.setattr(sys, "argv", ["command", *map(str, words)])
        main()

    return run


@pytest.fixture
def has_camera() -> bool:
    """Whether there is OpenGL to draw with."""
    try:
        open_gl(16, 16).free()
    except ConfigError:
        return False
    return True


def test_the_way_of_the_readme_ends_in_a_pretrained_generator(
    tmp_path: Path,
    command: Callable[..., None],
    has_camera: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(DOCS)
    import example_bag

    from pretrain.cli import main as eisp_pretrain

    bag, mapping, data = tmp_path / "my_bag", tmp_path / "my_bag.yaml", tmp_path / "data"
    flags = [] if has_camera else ["--no-camera"]
    command(example_bag.main, bag, "--episodes", EPISODES, *flags)
    lines = (DOCS / "example_bag.yaml").read_text().splitlines()
    mapping.write_text("\n".join(x for x in lines if has_camera or "images" not in x))
    command(eisp_data, "convert", bag, "--mapping", mapping, "--to", data)
    command(eisp_data, "validate", data)
    said = capsys.readouterr().out
    assert "0 failed, 0 to look at" in said and "FAIL" not in said
    seeds = range(SEED, SEED + EPISODES)
    simulated = collect(get_task("stack"), SCRIPTS["stack"], DEMONSTRATOR["stack"], seeds)
    for ours, theirs in zip(simulated, read_episodes(data, images=True), strict=True):
        assert set(theirs.images) == ({"front"} if has_camera else set())
        for name in ("achieved_goal", "desired_goal", "action", "reward", "success"):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
        # Rows lie at the commands, which are recorded 4 of 40 ms after the joints were read.
        fingers = ours.observation[:, 3:5]
        between = 0.9 * fingers[:-1] + 0.1 * fingers[1:]
        np.testing.assert_allclose(theirs.observation[:-1, :2], between, atol=1e-6)
        assert np.array_equal(ours.observation[:, :3], theirs.observation[:, 4:7])
    short = ("--updates", 2, "--batch-size", 8, "--generator-every", 1)
    train = ("--dataset.root", data, "--output-dir", tmp_path / "run", *short)
    command(eisp_pretrain, *train)
    assert f"policy: {tmp_path}" in capsys.readouterr().out
    assert (tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_a_recording_of_a_simulated_task_with_another_observation_says_what_to_choose(
    tmp_path: Path, command: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    from mcap_samples import record_session

    from pretrain.cli import main as eisp_pretrain

    source = record_session(tmp_path / "run.mcap", episodes=4, camera=False)
    command(eisp_data, "convert", source, "--to", tmp_path / "data")
    run, flags = tmp_path / "run", ("--updates", 2, "--batch-size", 8, "--agent.waypoints", 2)
    train = ("--dataset.root", tmp_path / "data", "--output-dir", run, *flags)
    with pytest.raises(SystemExit):
        command(eisp_pretrain, *train)
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("error: stack: observation and goal are not made of objects")
    assert not run.exists()
    plain = ("--agent.features", "plain", "--agent.generator", "hybrid")
    command(eisp_pretrain, *train, *plain)
    assert (run / "checkpoints/last/pretrained_model/model.safetensors").is_file()
