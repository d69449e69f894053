"""DatasetWriter: whole episodes into a LeRobot v3 dataset that is valid after every batch."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage import batch as batches
from eisp_data.storage.episodes import read_index
from eisp_data.storage.files import (
    WriterLock,
    make_folder,
    read_json,
    remove_temporaries,
    sync,
    write_json,
)
from eisp_data.storage.meta import (
    SIDECAR_PATH,
    compact_episodes,
    info_json,
    sidecar_json,
    stats_json,
    summed_stats,
    write_tasks,
)
from eisp_data.storage.reader import read_recipe, read_spec
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.stats import Stats, aggregate

STAGING = ".staging"


class DatasetWriter:
    """Appends batches of whole episodes; a kill at any moment loses at most the batch in hand.

    A batch is first written whole beside the dataset and synced, then its files are renamed into
    place: videos, rows, ``meta/episodes``, and last the summaries. Files are never appended to,
    so no footer is ever missing, and a batch counts once its ``meta/episodes`` file is there.
    """

    def __init__(
        self, root: Path | str, spec: DatasetSpec, recipe: Mapping[str, Any], resume: bool = False
    ) -> None:
        """Open ``root`` for writing.

        Args:
            root: the dataset's folder; made if missing.
            spec: shapes and names that every episode must have.
            recipe: how the episodes are made, JSON values; stored with the data.
            resume: go on after the last whole batch of a dataset that is already there, which
                must have the same spec and recipe.

        Raises:
            DataError: a dataset is there and ``resume`` is not set, spec or recipe differ, more
                of it is missing than a kill takes, or another writer has it open.
        """
        self.root = Path(root)
        self.spec = spec
        try:
            self.recipe: dict[str, Any] = json.loads(json.dumps(dict(recipe)))
        except (TypeError, ValueError) as error:
            raise DataError(f"recipe: only JSON values can be stored ({error})") from None
        exists = (self.root / "meta/info.json").exists()
        if exists and not resume:
            raise DataError(
                f"{self.root}: already holds a dataset; resume it or choose another folder"
            )
        if (
            not exists
            and self.root.exists()
            and any(
                not entry.name.startswith(".") and entry.name != "meta"
                for entry in self.root.iterdir()
            )
        ):
            raise DataError(f"{self.root}: not empty, and not a dataset; choose another folder")
        make_folder(self.root)
        self._lock = WriterLock(self.root)
        try:
            self._closed = False
            self._stats: dict[str, Stats] = {}
            self.num_episodes = self.num_frames = self._next_file = 0
            self._started_empty = not exists
            remove_temporaries(self.root / "meta")
            if exists:
                self._recover()
            else:
                self._start()
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the dataset; what was written stays, whatever was raised."""
        self.close()

    def write(
        self,
        episodes: Sequence[Episode],
        extras: Sequence[Mapping[str, np.ndarray]] | None = None,
    ) -> None:
        """Append whole episodes; on return they are on the disk.

        Args:
            episodes: any number, each of the dataset's spec. Large batches are committed in
                parts of about 90 MB.
            extras: for each episode the spec's extra columns, (T, width) float32.

        Raises:
            DataError: an episode does not fit, before anything is written; or the disk is full
                or unwritable, with the dataset left as it was before the part in hand.
        """
        prepared = batches.prepare(self.spec, self.recipe, episodes, extras, self.num_episodes)
        for part in batches.split(prepared, self.spec):
            try:
                self._commit(part)
            except OSError as error:
                raise DataError(
                    f"{self.root}: {error.strerror or error}; the {self.num_episodes} episodes "
                    "written before are safe"
                ) from error
            finally:
                shutil.rmtree(self.root / STAGING, ignore_errors=True)

    def close(self) -> None:
        """Tidy up and let other writers in; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if self.num_episodes:
                with suppress(OSError):  # only tidying: on a full disk the dataset is whole without
                    compact_episodes(self.root)
            elif self._started_empty:
                self._remove_empty()
        finally:
            self._lock.release()

    def _start(self) -> None:
        shutil.rmtree(self.root / STAGING, ignore_errors=True)
        sidecar = self.root / SIDECAR_PATH
        make_folder(sidecar.parent)
        write_json(sidecar, sidecar_json(self.spec, self.recipe))
        sync(sidecar.parent)
        write_tasks(self.root, self.spec.instruction)
        write_json(self.root / "meta/info.json", info_json(self.spec, 0, 0))

    def _recover(self) -> None:
        """Drop what an interrupted batch left, and bring the summaries up to the episodes.

        Nothing is removed unless all that is there can be what an interrupted batch left.
        """
        self._check_same()
        index = read_index(self.root)
        info = read_json(self.root / "meta/info.json")
        self._check_stated(info.get("total_episodes"), len(index))
        batches.check_columns(index, self.spec)
        orphans = batches.find_orphans(index, self.spec)
        shutil.rmtree(self.root / STAGING, ignore_errors=True)
        if index.stale:
            sync(index.tables[0].parent)  # as in compact_episodes, which was interrupted
        for path in (*index.stale, *orphans):
            path.unlink()
        self._next_file = batches.next_file(self.root)
        self.num_episodes, self.num_frames = len(index), int(index.length.sum())
        self._stats = summed_stats(self.root, index)
        if (info.get("total_episodes"), info.get("total_frames")) != (
            self.num_episodes,
            self.num_frames,
        ):
            if self._stats:
                write_json(self.root / "meta/stats.json", stats_json(self._stats))
            summary = info_json(self.spec, self.num_episodes, self.num_frames)
            write_json(self.root / "meta/info.json", summary)

    def _check_stated(self, stated: object, found: int) -> None:
        """Raise DataError if ``info.json``, always written last, knows of more episodes."""
        if not isinstance(stated, int) or stated > found:
            raise DataError(
                f"{self.root}: info.json says {stated} episodes, meta/episodes has {found}; "
                "run eisp-data repair first"
            )

    def _check_same(self) -> None:
        spec, recipe = read_spec(self.root), read_recipe(self.root)
        for name, here, given in (
            ("spec", spec.to_json(), self.spec.to_json()),
            ("recipe", recipe, self.recipe),
        ):
            differing = [k for k in {**here, **given} if here.get(k) != given.get(k)]
            if differing:
                key = "task" if "task" in differing else sorted(differing)[0]
                raise DataError(
                    f"{self.root}: cannot resume, its {name} differs in {key!r}: "
                    f"{here.get(key)!r} there, {given.get(key)!r} now"
                )

    def _commit(self, part: batches.Batch) -> None:
        staging = self.root / STAGING
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        stats = part.stats()
        staged = batches.stage(part, stats, self.spec, self.num_frames, self._next_file, staging)
        totals = {
            name: aggregate(
                [
                    *([self._stats[name]] if name in self._stats else []),
                    *(episode[name] for episode in stats),
                ]
            )
            for name in stats[0]
        }
        episodes = self.num_episodes + len(part.episodes)
        frames = self.num_frames + part.num_frames
        for name, value in (
            ("stats.json", stats_json(totals)),
            ("info.json", info_json(self.spec, episodes, frames)),
        ):
            write_json(staging / name, value)
            staged.append((staging / name, Path("meta") / name))
        self._put_in_place(staged)
        self._stats, self.num_episodes, self.num_frames = totals, episodes, frames
        self._next_file += 1

    def _put_in_place(self, staged: Sequence[tuple[Path, Path]]) -> None:
        """Rename files into place, in order, also on the disk.

        Each file of ``meta`` counts on those before it, so a cut cable may not keep it alone.
        """
        renamed: set[Path] = set()
        for source, target in staged:
            final = self.root / target
            make_folder(final.parent)
            if target.parts[0] == "meta":
                while renamed:
                    sync(renamed.pop())
            os.replace(source, final)
            renamed.add(final.parent)
        while renamed:
            sync(renamed.pop())

    def _remove_empty(self) -> None:
        """Leave nothing of a dataset that never got an episode."""
        for name in ("meta/info.json", "meta/tasks.parquet", SIDECAR_PATH):
            (self.root / name).unlink(missing_ok=True)
        for name in ("meta/eisp", "meta"):
            shutil.rmtree(self.root / name, ignore_errors=True)
