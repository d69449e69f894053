"""Sharing datasets, recordings and policies on a Hub: all of it arrives, or nothing does.

The endpoint and the token come from where ``huggingface_hub`` looks for them: ``HF_ENDPOINT``,
``HF_TOKEN`` or its login.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from eisp_data.errors import ConfigError, DataError
from eisp_data.hub_trust import refuse_path, refuse_pickle, verify
from eisp_data.storage.cache import fingerprint
from eisp_data.storage.card import CARD, CITATION, PREVIEW, dataset_card, policy_card
from eisp_data.storage.checks import Check
from eisp_data.storage.files import make_partial, no_writer, one_line
from eisp_data.storage.mcap.check import checks as recording_checks
from eisp_data.storage.mcap.summary import recordings
from eisp_data.storage.schema import CODEBASE_VERSION
from eisp_data.storage.validate import validate
from eisp_data.view import preview_png

Kind = Literal["dataset", "recording", "policy"]
DATASET_FOLDERS = ("data", "meta", "videos")
WHOLE = ("whole", "message count")
"""Checks of a recording that must pass before it is sent."""


@dataclass(frozen=True)
class Item:
    """One file of a push."""

    path: str
    """Its place in the repository."""
    content: Path | bytes

    @property
    def size(self) -> int:
        """Return its size in bytes."""
        return len(self.content) if isinstance(self.content, bytes) else self.content.stat().st_size


@dataclass
class Plan:
    """Exactly what a push would send."""

    repo_id: str
    repo_type: str
    kind: Kind
    items: list[Item] = field(default_factory=list)
    tag: str = ""
    root: Path | None = None
    """Of a dataset: its folder, and what its data were when they were checked."""
    fingerprint: str = ""

    def lines(self) -> list[str]:
        """Return the plan as lines of text."""
        total = sum(item.size for item in self.items)
        head = f"{len(self.items)} files, {total} bytes, to the {self.repo_type} {self.repo_id}"
        tag = [f"tag {self.tag}"] if self.tag else []
        return [head, *(f"{item.size:>12}  {item.path}" for item in self.items), *tag]


def kind_of(path: Path) -> Kind:
    """Return what a folder or file holds; DataError names what is known."""
    if (path / "meta/info.json").is_file():
        return "dataset"
    if (path / "config.json").is_file() and (path / "model.safetensors").is_file():
        return "policy"
    if path.suffix == ".mcap" or (path.is_dir() and any(path.glob("*.mcap"))):
        return "recording"
    raise DataError(
        f"{path}: neither a dataset (meta/info.json), a policy (config.json and "
        "model.safetensors) nor MCAP recordings"
    )


def plan_push(
    path: Path, repo_id: str, license_name: str = "apache-2.0", citation: str = CITATION
) -> Plan:
    """Return what ``push`` would send, having checked all of it; nothing is sent.

    A dataset must pass every check of ``validate``; a card and a preview are made for it, and a
    card for a policy, unless they have their own. MCAP recordings must be whole, and go to a
    repository of their own, whose name ends in ``-raw``.

    Raises:
        DataError: a check fails (its name and detail), a writer has the dataset open, or a policy
            holds a pickled file.
        ConfigError: ``repo_id`` is not ``owner/name``.
    """
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repo_id) or ".." in repo_id:
        raise ConfigError(f"repository {repo_id!r}: expected owner/name")
    kind = kind_of(path)
    if kind == "recording":
        raw = repo_id if repo_id.endswith("-raw") else f"{repo_id}-raw"
        files = recordings(path)
        for file in files:  # what a recorder dropped is lost anyway: that is no reason to refuse
            _refuse_failed(file, [check for check in recording_checks(file) if check.name in WHOLE])
        return Plan(raw, "dataset", kind, [Item(file.name, file) for file in files])
    if kind == "policy":
        items = [Item(p.relative_to(path).as_posix(), p) for p in _files(path)]
        for item in items:
            refuse_pickle(item.path, path / item.path)
        if CARD not in [item.path for item in items]:
            items.append(Item(CARD, policy_card(path, license_name, citation).encode()))
        return Plan(repo_id, "model", kind, items)
    with no_writer(path):
        return _plan_dataset(path, repo_id, license_name, citation)


def _plan_dataset(path: Path, repo_id: str, license_name: str, citation: str) -> Plan:
    key = fingerprint(path)
    _refuse_failed(path, validate(path))
    for folder in DATASET_FOLDERS:
        _refuse_link(path / folder)
    items = [
        Item(p.relative_to(path).as_posix(), p) for f in DATASET_FOLDERS for p in _files(path / f)
    ]
    own = path / CARD
    card = (
        own.read_bytes() if own.is_file() else dataset_card(path, license_name, citation).encode()
    )
    items += [Item(CARD, card), Item(PREVIEW, preview_png(path))]
    return Plan(repo_id, "dataset", "dataset", items, CODEBASE_VERSION, path, key)


def push(plan: Plan, private: bool = False) -> str:
    """Send a plan in one commit and return its address.

    An upload that was cut goes on where it stopped: files that have arrived are not sent again,
    and nobody sees any of them before all have. What an earlier push left and this one has not
    (``data``, ``meta`` and ``videos`` only) is removed in the same commit.

    Raises:
        DataError: the Hub cannot be reached or refuses, or a dataset is not as it was planned, or
            a writer has it open.
    """
    if plan.root is None:
        return _send(plan, private)
    with no_writer(plan.root):
        if fingerprint(plan.root) != plan.fingerprint:
            raise DataError(f"{plan.root}: changed after it was checked; run it again")
        return _send(plan, private)


def _send(plan: Plan, private: bool) -> str:
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi

    api = HfApi()
    with _one_line_errors(f"{plan.repo_id}: push"):
        api.create_repo(plan.repo_id, repo_type=plan.repo_type, private=private, exist_ok=True)
        operations: list[Any] = [
            CommitOperationAdd(
                path_in_repo=item.path,
                path_or_fileobj=str(item.content)
                if isinstance(item.content, Path)
                else item.content,
            )
            for item in plan.items
        ]
        if plan.kind == "dataset":
            sent = {item.path for item in plan.items}
            for there in api.list_repo_files(plan.repo_id, repo_type=plan.repo_type):
                if there not in sent and there.split("/")[0] in DATASET_FOLDERS:
                    operations.append(CommitOperationDelete(path_in_repo=there))
        commit = api.create_commit(
            plan.repo_id,
            operations,
            commit_message=f"Upload {plan.kind}",
            repo_type=plan.repo_type,
        )
        if plan.tag:
            refs = api.list_repo_refs(plan.repo_id, repo_type=plan.repo_type)
            if any(ref.name == plan.tag for ref in refs.tags):
                api.delete_tag(plan.repo_id, tag=plan.tag, repo_type=plan.repo_type)
            api.create_tag(
                plan.repo_id, tag=plan.tag, revision=commit.oid, repo_type=plan.repo_type
            )
    return str(commit.commit_url)


def pull(repo_id: str, to: Path, repo_type: str = "dataset", revision: str | None = None) -> int:
    """Fetch a dataset, recordings or a policy into the new folder ``to``; return its bytes.

    Every file's checksum is compared with the one the Hub states; a dataset must pass ``validate``.
    Until then everything is in a hidden folder beside ``to``, which is removed on any failure.

    Args:
        repo_id: ``owner/name``.
        to: folder to make.
        repo_type: ``dataset`` or ``model``.
        revision: branch, tag or commit; the default branch if left out.

    Raises:
        DataError: ``to`` exists, the Hub cannot be reached, a path climbs out of the folder, a
            file is pickled, a checksum is wrong, or the dataset is damaged.
    """
    from huggingface_hub import HfApi

    if to.exists():
        raise DataError(f"{to}: exists already; choose another folder")
    api = HfApi()
    with _one_line_errors(f"{to}"):
        partial = make_partial(to)
    try:
        with _one_line_errors(f"{repo_id}: pull"):
            commit = api.repo_info(repo_id, repo_type=repo_type, revision=revision).sha
            entries = [
                entry
                for entry in api.list_repo_tree(
                    repo_id, recursive=True, repo_type=repo_type, revision=commit
                )
                if hasattr(entry, "size")
            ]
            for entry in entries:
                refuse_path(entry.path)
            total = sum(entry.size for entry in entries)
            if shutil.disk_usage(partial).free < total:
                raise DataError(f"{to}: {total} bytes do not fit on the disk")
            for entry in entries:
                api.hf_hub_download(
                    repo_id, entry.path, repo_type=repo_type, revision=commit, local_dir=partial
                )
                verify(partial / entry.path, entry)
        # Its download notes would make LeRobot fetch the dataset again.
        shutil.rmtree(partial / ".cache", ignore_errors=True)
        if (partial / "meta/info.json").is_file():
            for check in validate(partial):
                if not check.passed:
                    raise DataError(f"{repo_id}: check {check.name!r} fails: {check.detail}")
        os.rename(partial, to)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return total


def _refuse_failed(path: Path, checks: Sequence[Check]) -> None:
    for check in checks:
        if not check.passed:
            raise DataError(f"{path}: check {check.name!r} fails: {check.detail}; repair it first")


def _files(folder: Path) -> list[Path]:
    """Return the files under a folder but hidden ones, in order; DataError if one is a link."""
    files = []
    for path in sorted(folder.rglob("*")):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        _refuse_link(path)
        if path.is_file():
            files.append(path)
    return files


def _refuse_link(path: Path) -> None:
    if path.is_symlink():  # what it leads to may be outside, and may be private
        raise DataError(f"{path}: a link; push a copy that has the files themselves (cp -rL)")


@contextmanager
def _one_line_errors(what: str) -> Iterator[None]:
    """Turn what the client and the network raise into a DataError of one line."""
    import httpx
    from huggingface_hub import constants
    from huggingface_hub.errors import (
        EntryNotFoundError,
        HfHubHTTPError,
        HFValidationError,
        OfflineModeIsEnabled,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        yield
    except (RepositoryNotFoundError, RevisionNotFoundError, EntryNotFoundError) as error:
        raise DataError(f"{what}: not found or not visible ({one_line(error)})") from None
    except HfHubHTTPError as error:
        raise DataError(f"{what}: the Hub refused ({one_line(error)})") from None
    except OfflineModeIsEnabled:
        raise DataError(f"{what}: HF_HUB_OFFLINE is set; unset it to reach a Hub") from None
    except httpx.ConnectError as error:
        raise DataError(
            f"{what}: cannot reach {constants.ENDPOINT} ({one_line(error)}); run it again"
        ) from None
    except (httpx.HTTPError, HFValidationError, OSError, RuntimeError, ValueError) as error:
        cause = error.__cause__ or error
        raise DataError(f"{what}: failed ({one_line(cause)}); run it again") from None
