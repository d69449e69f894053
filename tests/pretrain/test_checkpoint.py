"""Checkpoints: whole or not there, whenever the process is killed, and exact."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from learning_samples import linear_agent

from eisp_data.errors import DataError
from eisp_data.runs import checkpoint as runs
from pretrain import checkpoint
from pretrain.agent import Agent


class Killed(BaseException):
    """The process ends here."""


class Training:
    """An agent, its optimizer and its random numbers."""

    def __init__(self, seed: int = 0, goal_dim: int = 2) -> None:
        self.agent = linear_agent(goal_dim)
        self.optimizers = {"actor": torch.optim.Adam(self.agent.sac.actor.parameters(), lr=0.1)}
        self.rng = np.random.default_rng(seed)
        torch.manual_seed(seed)

    def learn(self) -> None:
        """Take one random step."""
        loss = sum((p * torch.randn_like(p)).sum() for p in self.agent.sac.actor.parameters())
        self.optimizers["actor"].zero_grad()
        loss.backward()  # type: ignore[union-attr]
        self.optimizers["actor"].step()
        self.rng.random(7)

    def save(self, run: Path, step: int) -> None:
        transposed = np.arange(12.0).reshape(3, 4).T
        arrays = {"odd": transposed, "scalar": np.array(step), "none": np.empty((0, 3))}
        checkpoint.save(run, step, self.agent, self.optimizers, self.rng, {"note": [step]}, arrays)

    def restore(self, run: Path):
        return checkpoint.restore(run, self.agent, self.optimizers, self.rng)

    def digest(self) -> list[float]:
        parameters = [value for p in self.agent.parameters() for value in p.flatten().tolist()]
        return [*parameters, torch.rand(1).item(), float(self.rng.random())]


def steps_of(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "checkpoints").iterdir())


def test_what_was_interrupted_goes_on_as_if_it_had_not_been(tmp_path):
    first = Training()
    for _ in range(3):
        first.learn()
    first.save(tmp_path, 3)
    for _ in range(3):
        first.learn()
    expected = first.digest()
    again = Training(seed=9)
    step, numbers, arrays = again.restore(tmp_path)
    for _ in range(3):
        again.learn()
    assert again.digest() == expected
    assert (step, numbers) == (3, {"note": [3]})
    assert (arrays["odd"] == np.arange(12.0).reshape(3, 4).T).all()
    assert arrays["scalar"] == 3 and arrays["none"].shape == (0, 3)
    assert all(array.flags.writeable for array in arrays.values())


def test_an_optimizer_that_has_not_stepped_can_be_saved(tmp_path):
    Training().save(tmp_path, 0)
    assert Training(seed=1).restore(tmp_path)[0] == 0


@pytest.mark.parametrize(
    ("steps", "kept"),
    [([5], ["000005"]), ([1, 2, 3, 12], ["000003", "000012"]),
     ([999_998, 999_999, 1_000_000], ["1000000", "999999"])],
)  # fmt: skip
def test_only_the_newest_two_are_kept(tmp_path, steps, kept):
    training = Training()
    for step in steps:
        training.save(tmp_path, step)
    assert steps_of(tmp_path) == [*kept, "last"]
    assert training.restore(tmp_path)[0] == steps[-1]


@pytest.mark.parametrize("followed", [False, True])
def test_a_run_goes_on_where_a_copy_has_lost_its_link_or_made_a_folder_of_it(tmp_path, followed):
    training, run = Training(), tmp_path / "copy"
    for step in (1, 2):
        training.save(tmp_path / "run", step)
    shutil.copytree(tmp_path / "run", run)  # follows the link
    if not followed:
        shutil.rmtree(run / "checkpoints/last")
    assert runs.exists(run) and training.restore(run)[0] == 2
    training.save(run, 3)
    assert steps_of(run) == ["000002", "000003", "last"]
    assert (run / "checkpoints/last").resolve().name == "000003"


def test_nothing_is_pickled(tmp_path):
    Training().save(tmp_path, 1)
    files = {p.name for p in (tmp_path / "checkpoints/000001").rglob("*") if p.is_file()}
    assert files == {"config.json", "model.safetensors", "state.json", "state.safetensors"}


def test_a_kill_between_draft_and_rename_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    training = Training()
    training.save(tmp_path, 1)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(Killed))
        with pytest.raises(Killed):
            training.save(tmp_path, 2)
    assert (tmp_path / "checkpoints/.000002.draft").exists()
    assert training.restore(tmp_path)[0] == 1
    training.save(tmp_path, 2)
    assert steps_of(tmp_path) == ["000001", "000002", "last"]


def test_whenever_a_save_is_killed_the_last_checkpoint_is_whole(tmp_path, monkeypatch):
    training = Training()
    for step in (1, 2):
        training.save(tmp_path / "whole", step)
    places = [(Path, name) for name in ("rename", "symlink_to", "unlink", "mkdir", "write_text")]
    places += [(os, "replace"), (shutil, "rmtree"), (runs, "sync"), (Agent, "save")]
    kills = 0
    for kill_at in range(100):
        run = tmp_path / str(kill_at)
        shutil.copytree(tmp_path / "whole", run, symlinks=True)
        calls = iter(range(100))
        with monkeypatch.context() as patch:
            for owner, name in places:
                patch.setattr(owner, name, killing(getattr(owner, name), calls, kill_at))
            try:
                training.save(run, 3)
                killed = False
            except Killed:
                killed = True
        kills += killed
        assert runs.exists(run)
        assert Training().restore(run)[0] in ((2, 3) if killed else (3,))
        Training().save(run, 3)
        assert steps_of(run) == ["000002", "000003", "last"]
        if not killed:
            break
    assert kills > 15


def killing(function, calls, kill_at):
    """Return the function, but killed before the call of that number."""

    def run(*args, **kwargs):
        if next(calls) == kill_at:
            raise Killed
        return function(*args, **kwargs)

    return run


@pytest.mark.parametrize("name", ["state.json", "state.safetensors"])
@pytest.mark.parametrize("how", ["missing", "empty", "truncated"])
def test_a_damaged_state_is_told_in_one_line(tmp_path, name, how):
    training = Training()
    training.learn()
    training.save(tmp_path, 4)
    path = tmp_path / "checkpoints/last/training_state" / name
    content = path.read_bytes()
    path.unlink()
    if how != "missing":
        path.write_bytes(content[: len(content) // 2] if how == "truncated" else b"")
    with pytest.raises(DataError, match="000004 cannot be resumed from: ") as caught:
        training.restore(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_an_agent_with_other_settings_is_told_in_one_line(tmp_path):
    Training().save(tmp_path, 4)
    with pytest.raises(DataError, match=r"cannot be resumed from: .*size mismatch") as caught:
        Training(goal_dim=5).restore(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_run_without_a_checkpoint_says_so(tmp_path):
    assert not runs.exists(tmp_path)
    with pytest.raises(DataError, match="holds no checkpoint"):
        Training().restore(tmp_path)


def test_a_full_disk_is_one_line_and_the_checkpoint_before_stays_whole(small_disk):
    run = small_disk("400k")
    training = Training()
    training.learn()
    training.save(run, 1)
    needed = sum(-(-path.stat().st_size // 4096) for path in run.rglob("*.*"))
    fill = run / "fill"
    failed = set()
    for room in range(1, needed):  # in blocks: each of its files is once the one without room
        free = os.statvfs(run).f_bavail * os.statvfs(run).f_frsize
        fill.write_bytes(bytes(free - room * 4096))
        with pytest.raises(DataError, match=r"cannot be written: .*No space left") as caught:
            training.save(run, 2)
        assert "\n" not in str(caught.value)
        failed.add(str(caught.value).split(" cannot")[0])
        assert steps_of(run) == ["000001", "last"]
        fill.unlink()
    assert len(failed) == 2, "the policy, and the training state"
    training.save(run, 2)
    assert steps_of(run) == ["000001", "000002", "last"]
