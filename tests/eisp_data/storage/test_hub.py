"""Push and pull against a Hub on loopback, driven by the real client."""

from __future__ import annotations

import json
import pickle
import random
import sys

import pytest
from hub_server import TOKEN, Hub
from storage_samples import assert_same, random_episode, spec_of

from eisp_data import hub
from eisp_data.errors import ConfigError, DataError
from eisp_data.storage.cache import load_arrays
from eisp_data.storage.lerobot import DatasetWriter, read_episodes
from eisp_data.storage.mcap import messages
from eisp_data.storage.mcap.writer import McapWriter
from eisp_data.storage.validate import validate

REPO = "lab/stack"


@pytest.fixture
def server(monkeypatch):
    """Return a running Hub that the client is pointed to."""
    from huggingface_hub import constants

    with Hub() as running:
        monkeypatch.setattr(constants, "ENDPOINT", running.endpoint)
        template = running.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr("huggingface_hub.lfs.http_backoff", _no_patience)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield running


def _no_patience(method, url, **options):
    """Try as often as the client does, without its pauses."""
    from huggingface_hub.utils import http_backoff

    return http_backoff(method, url, base_wait_time=0.001, max_wait_time=0.002, **options)


def test_a_dataset_comes_back_as_it_went(make_dataset, server, tmp_path):
    root, episodes = make_dataset(cameras=True)
    address = hub.push(hub.plan_push(root, REPO))
    assert address.startswith(server.endpoint)
    hub.pull(REPO, tmp_path / "back", revision="v3.0")
    for ours, theirs in zip(episodes, read_episodes(tmp_path / "back", images=True), strict=True):
        assert_same(ours, theirs)
    assert all(check.passed for check in validate(tmp_path / "back"))
    assert not (tmp_path / "back/.cache").exists()
    for folder in hub.DATASET_FOLDERS:
        for path in (root / folder).rglob("*"):
            if path.is_file():
                assert (
                    tmp_path / "back" / path.relative_to(root)
                ).read_bytes() == path.read_bytes()


def test_the_card_says_what_one_wants_to_know(make_dataset, server):
    root, episodes = make_dataset()
    hub.push(hub.plan_push(root, REPO, "cc-by-4.0"))
    files = server.files("dataset", REPO)
    card = files["README.md"].decode()
    successes = sum(bool(episode.success[-1]) for episode in episodes)
    for said in (
        "license: cc-by-4.0",
        "Stack the blocks.",
        '"policy": "script"',
        "@misc{eisp",
        "5 episodes, 40 frames at 25 Hz",
        f"{successes} of them",
        "preview.png",
        "| action |",
    ):
        assert said in card, said
    assert files["preview.png"].startswith(b"\x89PNG")
    assert server.files("dataset", REPO, "v3.0") == files


def run_command(monkeypatch, capsys, *words):
    """Run ``eisp-data`` and return what it prints."""
    from eisp_data.cli.data import main

    monkeypatch.setattr(sys, "argv", ["eisp-data", *map(str, words)])
    main()
    return capsys.readouterr().out


def test_a_dry_run_lists_exactly_what_a_push_sends(make_dataset, server, monkeypatch, capsys):
    root, _ = make_dataset(cameras=True)
    load_arrays(root)  # its cache is no part of it
    push = ("push", root, "--repo-id", REPO)
    with monkeypatch.context() as patch:
        patch.setattr("socket.socket.connect", None)
        said = run_command(patch, capsys, *push, "--dry-run").splitlines()
    assert not server.repos
    assert run_command(monkeypatch, capsys, *push).startswith("sent ")
    sent = server.files("dataset", REPO)
    listed = {path: int(size) for size, path in (line.split() for line in said[2:-1])}
    assert listed == {path: len(content) for path, content in sent.items()}
    total = sum(listed.values())
    assert said[:2] == ["would send", f"{len(sent)} files, {total} bytes, to the dataset {REPO}"]
    assert said[-1] == "tag v3.0"


def test_a_dataset_that_fails_a_check_is_not_sent(make_dataset, server):
    root, _ = make_dataset()
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "total_frames": 1}))
    with pytest.raises(DataError, match="check 'frame count' fails"):
        hub.plan_push(root, REPO)
    assert not server.repos


def test_what_a_writer_is_at_work_on_is_not_sent(make_dataset, server):
    root, _ = make_dataset()
    plan = hub.plan_push(root, REPO)
    recipe = {"policy": "script", "seed": 0}
    with DatasetWriter(root, spec_of(), recipe, resume=True) as writer:
        for attempt in (lambda: hub.plan_push(root, REPO), lambda: hub.push(plan)):
            with pytest.raises(DataError, match="another writer of this process"):
                attempt()
        writer.write([random_episode(spec_of(), 6, 70)])
    with pytest.raises(DataError, match="changed after it was checked; run it again"):
        hub.push(plan)
    assert not server.repos
    hub.push(hub.plan_push(root, REPO))


def test_no_writer_begins_while_a_dataset_is_checked_or_sent(make_dataset, monkeypatch):
    root, _ = make_dataset()
    recipe, refused = {"policy": "script", "seed": 0}, []

    def try_to_write(*words, **_options):
        with pytest.raises(DataError, match="another writer"):
            DatasetWriter(root, spec_of(), recipe, resume=True)
        refused.append(words[0])
        return []

    monkeypatch.setattr(hub, "validate", try_to_write)
    monkeypatch.setattr(hub, "_send", try_to_write)
    plan = hub.plan_push(root, REPO)
    hub.push(plan)
    assert refused == [root, plan]
    DatasetWriter(root, spec_of(), recipe, resume=True).close()


@pytest.mark.parametrize("what", ["data", "data/chunk-000"])
def test_links_are_refused_instead_of_sending_a_dataset_without_them(
    make_dataset, server, tmp_path, what
):
    root, _ = make_dataset()
    (root / what).rename(tmp_path / "elsewhere")
    (root / what).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match=r": a link; push a copy"):
        hub.plan_push(root, REPO)


def test_a_cut_upload_goes_on_where_it_stopped(make_dataset, server):
    root, _ = make_dataset(cameras=True)
    plan = hub.plan_push(root, REPO)
    server.cut_after = 3
    with pytest.raises(DataError, match="run it again") as caught:
        hub.push(plan)
    assert "\n" not in str(caught.value)
    arrived = set(server.uploads)
    assert 0 < len(arrived) < sum(item.path.endswith((".parquet", ".mp4")) for item in plan.items)
    assert server.files("dataset", REPO) == {}, "nobody sees a part"
    server.cut_after, server.uploads = None, []
    hub.push(hub.plan_push(root, REPO))
    assert not arrived & set(server.uploads), "what has arrived is not sent again"
    assert set(server.files("dataset", REPO)) == {item.path for item in plan.items}


def test_pushing_again_replaces_files_and_moves_the_tag(make_dataset, server, tmp_path):
    root, _ = make_dataset("first", cameras=True)
    hub.push(hub.plan_push(root, REPO))
    second, episodes = make_dataset("second", count=2, seed=50, cameras=True)
    hub.push(hub.plan_push(second, REPO))
    hub.pull(REPO, tmp_path / "back", revision="v3.0")
    for ours, theirs in zip(episodes, read_episodes(tmp_path / "back"), strict=True):
        assert_same(ours, theirs)


def test_recordings_go_to_a_repository_of_their_own_if_they_are_whole(server, tmp_path):
    path = tmp_path / "run.mcap"
    with McapWriter(path) as writer:
        for k in range(200):
            writer.log("/noise", messages.image(random.Random(k).randbytes(2000), k), k)
    hub.push(hub.plan_push(path, REPO))
    assert server.files("dataset", f"{REPO}-raw") == {"run.mcap": path.read_bytes()}
    assert ("dataset", REPO) not in server.repos
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:300_000])
    with pytest.raises(DataError, match=r"cut.mcap: check 'whole' fails: .*; repair it first"):
        hub.plan_push(tmp_path / "cut.mcap", REPO)


def test_a_policy_comes_back_and_one_that_is_pickled_does_not_go(server, tmp_path):
    policy = tmp_path / "pretrained_model"
    policy.mkdir()
    (policy / "config.json").write_text('{"agent": {"task": "stack"}}')
    (policy / "model.safetensors").write_bytes(bytes(50))
    (tmp_path / "link").symlink_to(policy)  # whoever names a link means what it leads to
    hub.push(hub.plan_push(tmp_path / "link", "lab/policy", "mit"))
    card = server.files("model", "lab/policy")["README.md"].decode()
    assert "license: mit" in card and "- stack" in card and "@misc{eisp" in card
    hub.pull("lab/policy", tmp_path / "back", repo_type="model")
    assert (tmp_path / "back/model.safetensors").read_bytes() == bytes(50)
    (policy / "notes.dat").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(DataError, match=r"'notes.dat' is pickled"):
        hub.plan_push(policy, "lab/policy")


class TestPullLeavesNothingBehind:
    @pytest.fixture
    def pushed(self, make_dataset, server):
        root, _ = make_dataset()
        hub.push(hub.plan_push(root, REPO))
        return server

    def refused(self, tmp_path, match):
        with pytest.raises(DataError, match=match) as caught:
            hub.pull(REPO, tmp_path / "back")
        assert "\n" not in str(caught.value)
        assert not [p for p in tmp_path.iterdir() if "back" in p.name]

    @pytest.mark.parametrize("path", ["../evil.json", "/etc/evil", "data/../../evil", "C:\\evil"])
    def test_of_a_path_that_climbs_out(self, pushed, tmp_path, path):
        pushed.listed = [{"type": "file", "path": path, "oid": "0" * 40, "size": 1}]
        self.refused(tmp_path, "climbs out of the folder")

    @pytest.mark.parametrize("path", ["model.pkl", "weights.pt", "data/x.NPY"])
    def test_of_a_file_that_is_pickled_by_name(self, pushed, tmp_path, path):
        pushed.listed = [{"type": "file", "path": path, "oid": "0" * 40, "size": 1}]
        self.refused(tmp_path, "may be pickled")

    def test_of_a_file_that_is_pickled_by_content(self, pushed, tmp_path):
        content = pickle.dumps({"a": 1})
        repo = pushed.repos["dataset", REPO]
        repo.commits[repo.branches["main"]]["meta/extra.json"] = content
        self.refused(tmp_path, "is pickled")

    @pytest.mark.parametrize("path", ["data/chunk-000/file-000.parquet", "meta/info.json"])
    def test_of_a_wrong_checksum(self, pushed, tmp_path, path):
        changed = bytearray(pushed.files("dataset", REPO)[path])
        changed[len(changed) // 2] ^= 1
        pushed.forge[path] = bytes(changed)
        self.refused(tmp_path, "does not have the checksum")

    def test_of_a_file_that_ends_early(self, pushed, tmp_path):
        path = "data/chunk-000/file-000.parquet"
        pushed.forge[path] = pushed.files("dataset", REPO)[path][:-100]
        self.refused(tmp_path, "failed|checksum")

    def test_of_a_repository_that_is_not_there(self, pushed, tmp_path):
        with pytest.raises(DataError, match="not found"):
            hub.pull("lab/other", tmp_path / "back")

    def test_into_a_folder_that_is_there(self, pushed, tmp_path):
        (tmp_path / "back").mkdir()
        with pytest.raises(DataError, match="exists already"):
            hub.pull(REPO, tmp_path / "back")


def test_a_hub_that_does_not_answer_is_named(server, monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(DataError, match=r"cannot reach http://127.0.0.1:9 \(") as caught:
        hub.pull(REPO, tmp_path / "back")
    assert "\n" not in str(caught.value) and not (tmp_path / "back").exists()


def test_a_wrong_token_and_a_wrong_name_are_one_line_each(make_dataset, server, monkeypatch):
    root, _ = make_dataset()
    plan = hub.plan_push(root, REPO)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(DataError, match=r"the Hub refused|not found") as caught:
        hub.push(plan)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="expected owner/name"):
        hub.plan_push(root, "no-owner")
