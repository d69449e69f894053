"""Every check that a dataset should pass, by name, each run even if another fails."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from eisp_data.errors import DataError
from eisp_data.storage import signals
from eisp_data.storage.checks import Check
from eisp_data.storage.episodes import EpisodeIndex, check_cameras, read_index
from eisp_data.storage.files import read_json
from eisp_data.storage.parquet import group_rows, read_parquet
from eisp_data.storage.reader import check_version, read_blocks, read_spec
from eisp_data.storage.row_checks import ROW_CHECKS
from eisp_data.storage.schema import INDEX_FEATURES, SIDECAR_COLUMN, column_widths
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.video_checks import check_ends, check_frame_counts


def validate(root: Path | str) -> list[Check]:
    """Run every check on a dataset and return the results, in a fixed order.

    A check that cannot be run because an earlier one failed is left out; a damaged file is a
    failed check, not an error.

    Raises:
        DataError: ``root`` is not a LeRobot v3 dataset at all.
    """
    root = Path(root)
    info = check_version(root)
    results: list[Check] = []

    def run(name: str, check: Callable[[], Check | str]) -> bool:
        """Add the result of a check; a string is the detail of a passed one."""
        try:
            result = check()
        except DataError as error:
            result = Check(name, False, str(error).replace(f"{root}/", ""))
        except RecursionError:
            result = Check(name, False, "nested too deeply to be read")
        results.append(Check(name, True, result) if isinstance(result, str) else result)
        return results[-1].passed

    found: dict[str, Any] = {}

    def keep(name: str, value: Any, detail: str) -> str:
        found[name] = value
        return detail

    run("spec", lambda: keep("spec", spec := read_spec(root), f"{spec.task}, {spec.fps} Hz"))
    run(
        "episode table",
        lambda: keep("index", index := read_index(root), f"{len(index)} episodes"),
    )
    if "index" in found:
        run("episode count", lambda: _episode_count(info, found["index"]))
        run("frame count", lambda: _frame_count(info, found["index"]))
        run("no stray files", lambda: _stray(found["index"]))
    if len(found) == 2:
        _check_rows(root, info, found["spec"], found["index"], run)
        # Cameras that meta/episodes does not know have failed "features" already.
        if found["spec"].cameras and set(found["spec"].cameras) <= set(found["index"].video_file):
            run("video frames", lambda: check_frame_counts(found["index"], found["spec"]))
            run("video ends", lambda: check_ends(found["index"], found["spec"]))
    return results


def _check_rows(
    root: Path,
    info: dict[str, Any],
    spec: DatasetSpec,
    index: EpisodeIndex,
    run: Callable[[str, Callable[[], Check | str]], bool],
) -> None:
    """Run the checks that need the rows."""
    run("features", lambda: _features(info, spec, index))
    run("tasks", lambda: _tasks(root, spec))
    collected = signals.Collected(spec)
    wrong: dict[str, str] = {}

    def read() -> str:
        for block in read_blocks(root, spec, finite=False):
            collected.add(block)
            for name, (look, _) in ROW_CHECKS.items():
                try:
                    look(block, index)
                except DataError as error:
                    wrong.setdefault(name, str(error))
        return f"{collected.rows} rows, every column of its type and width"

    def found(name: str) -> str:
        if name in wrong:
            raise DataError(wrong[name])
        return ROW_CHECKS[name][1]

    if not run("rows", read) or not collected.rows:
        return
    for name in ROW_CHECKS:
        run(name, lambda name=name: found(name))  # type: ignore[misc]
    if "no NaN" not in wrong:
        run("statistics", lambda: _statistics(root, collected))
        run("stuck channels", collected.stuck)
        run("outliers", collected.outliers)
        run("action lag", collected.lag)
    if collected.repeated:
        run("repeated frames", collected.repeats)
    run("success", collected.success)


def _episode_count(info: dict[str, Any], index: EpisodeIndex) -> Check:
    stated = info.get("total_episodes")
    return Check("episode count", stated == len(index), f"{len(index)} found, {stated} stated")


def _frame_count(info: dict[str, Any], index: EpisodeIndex) -> Check:
    rows = 0
    for path in sorted({index.data_path(e) for e in range(len(index))}):
        rows += sum(group_rows(path))
    listed, stated = int(index.length.sum()), info.get("total_frames")
    same = rows == listed == stated
    detail = f"{rows} rows, {listed} in the episode table, {stated} stated"
    return Check("frame count", same, detail)


def _stray(index: EpisodeIndex) -> Check:
    used = {index.data_path(e) for e in range(len(index))} | set(index.tables)
    for camera in index.video_file:
        used |= {index.video_path(e, camera) for e in range(len(index))}
    folders = ("data", "videos", "meta/episodes")
    here = [p for f in folders for p in (index.root / f).rglob("*") if p.is_file()]
    stray = sorted(p.relative_to(index.root).as_posix() for p in here if p not in used)
    if (index.root / ".staging").exists():
        stray.append(".staging")
    return Check("no stray files", not stray, ", ".join(stray[:3]) or "every file is in use")


def _features(info: dict[str, Any], spec: DatasetSpec, index: EpisodeIndex) -> str:
    declared = info.get("features")
    if not isinstance(declared, dict):
        raise DataError("info.json: features is missing")
    expected = {n: (dtype, [width]) for n, (dtype, width) in column_widths(spec).items()}
    expected[SIDECAR_COLUMN] = ("string", [1])
    for name, (dtype, shape) in expected.items():
        entry = declared.get(name)
        if not isinstance(entry, dict):
            raise DataError(f"info.json: feature {name} is missing")
        if (entry.get("dtype"), entry.get("shape")) != (dtype, shape):
            raise DataError(
                f"info.json: feature {name} is {entry.get('dtype')} {entry.get('shape')}; "
                f"the spec says {dtype} {shape}"
            )
    check_cameras(index, spec)
    return f"{len(declared)} columns and cameras"


def _tasks(root: Path, spec: DatasetSpec) -> Check:
    table = read_parquet(root / "meta/tasks.parquet")
    texts = table.column("task").to_pylist() if "task" in table.column_names else []
    same = texts == [spec.instruction]
    return Check("tasks", same, f"{texts}" if same else f"{texts}; expected [{spec.instruction!r}]")


def _statistics(root: Path, collected: signals.Collected) -> str:
    stored = read_json(root / "meta/stats.json")
    # LeRobot's tools renumber the index columns and leave their statistics as they were.
    measured = {n: v for n, v in collected.extremes.items() if n not in INDEX_FEATURES}
    for name, (low, high) in measured.items():
        try:
            column = stored[name]
            values = {k: np.asarray(column[k], dtype=np.float64) for k in ("min", "max", "count")}
        except (KeyError, TypeError, ValueError):
            raise DataError(f"meta/stats.json: {name} is missing or incomplete") from None
        if values["count"].tolist() != [collected.rows]:
            raise DataError(
                f"meta/stats.json: {name} counts {values['count'].tolist()} rows; "
                f"there are {collected.rows}"
            )
        for word, there, here in (
            ("minimum", values["min"], low),
            ("maximum", values["max"], high),
        ):
            if there.shape != here.shape or not np.allclose(there, here, rtol=1e-5, atol=1e-6):
                raise DataError(f"meta/stats.json: {name}: the {word} is not that of the rows")
    return f"counts and extremes of {len(measured)} columns agree with the rows"
