"""One page on a run: how good the policy is, how it learned, where it fails, how it looks.

Reads what a run's folder holds: ``metrics.jsonl``, ``evaluation_before.json``,
``evaluation_after.json``, ``*.yaml`` and ``episode.mp4``. What is missing is left out with a word.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eisp_data.errors import ConfigError, DataError
from finetune import page
from finetune.charts import Level, Region, Series, bar_chart, line_chart
from finetune.results import HEAD, percent, result_rows, signed
from finetune.video import middle_frame

REPORT = "report.html"
_LEAD = "A policy that proposes subgoals on the way to a far goal, and reaches them one by one."
_OURS = (
    "Success is the paper's Eq. (1): the whole goal error is at most 5 cm. The return is minus the "
    "number of steps at which it is not. Relative to the oracle, 0% is never successful and 100% "
    "is as quick as the script."
)
_FOREIGN = "Success and rewards are the environment's own; the return is the sum of the rewards."
_BLUE, _TEAL, _RED = "#2563eb", "#0d9488", "#dc2626"
_PAPER, _ORACLE = "#b45309", "#15803d"
_PRETRAIN, _FINETUNE = "#ede9fe", "#f1f5f9"


@dataclass(frozen=True)
class Run:
    """What is known of a run."""

    folder: Path
    metrics: list[dict[str, Any]]
    before: dict[str, Any] | None
    after: dict[str, Any] | None
    configs: dict[str, str]
    """File name to text."""
    video: bytes | None
    empty: list[str]
    """Names of the evaluations whose files have nothing in them."""

    @property
    def task(self) -> str:
        """Name of the task; that of the folder if no evaluation names it."""
        return str((self.after or self.before or {}).get("task", self.folder.resolve().name))

    def stage(self, name: str, *keys: str) -> list[dict[str, Any]]:
        """Return the lines of one stage that have one of the keys."""
        return [m for m in self.metrics if m.get("stage") == name and any(k in m for k in keys)]


def write_report(run_dir: Path, output: Path | None = None) -> Path:
    """Write the page of a run and return its path, ``report.html`` in the run unless given.

    Raises:
        ConfigError: there is no such folder, it holds nothing of a run, or the page cannot be
            written.
        DataError: an evaluation is damaged.
    """
    path = output or run_dir / REPORT
    text = render(read_run(run_dir))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
    return path


def read_run(folder: Path) -> Run:
    """Read what there is."""
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    video = folder / "episode.mp4"
    before, after = folder / "evaluation_before.json", folder / "evaluation_after.json"
    found = {path: _read_evaluation(path) for path in (before, after)}
    run = Run(
        folder=folder,
        metrics=read_metrics(folder / "metrics.jsonl"),
        before=found[before],
        after=found[after],
        configs={path.name: path.read_text() for path in sorted(folder.glob("*.yaml"))},
        video=video.read_bytes() if video.exists() else None,
        empty=[path.name for path in found if found[path] is None and path.exists()],
    )
    if not (run.metrics or run.before or run.after):
        raise ConfigError(
            f"{folder} holds nothing to report on: metrics.jsonl, evaluation_before.json and "
            "evaluation_after.json are missing or empty"
        )
    return run


def render(run: Run) -> str:
    """Return the page as HTML."""
    name = run.task.replace("_", " ")
    title = f"{name[:1].upper()}{name[1:]}: what the policy has learned"
    return page.page(
        title,
        [
            f"<h1>{page.escape(title)}</h1>",
            _lead(run),
            page.cards(_cards(run)),
            _results(run),
            _video(run),
            _learning(run),
            _pretraining(run),
            _failures(run),
            _configuration(run),
            f"<footer>Run: {page.escape(str(run.folder))}</footer>",
        ],
    )


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's metrics; none if the file is missing."""
    lines = path.read_text().splitlines() if path.exists() else []
    entries = []
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:  # a line cut off by a kill
            continue
        if isinstance(entry, dict):
            entries.append(entry)
    return entries


def _read_evaluation(path: Path) -> dict[str, Any] | None:
    text = path.read_text().strip() if path.exists() else ""
    if not text:
        return None
    try:
        evaluation = json.loads(text)
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({error})") from None
    if not isinstance(evaluation, dict) or "success_last" not in evaluation:
        raise DataError(f"{path}: not an evaluation, success_last is missing")
    return evaluation


def _cards(run: Run) -> list[tuple[str, str]]:
    entries = []
    for evaluation, when in ((run.after, "after"), (run.before, "before")):
        if evaluation:
            entries.append(
                (percent(evaluation["success_last"]["mean"]), f"successful {when} fine-tuning")
            )
    evaluation = run.after or run.before
    if evaluation and evaluation.get("return"):
        paper = evaluation.get("paper_return")
        beside = f"; the paper reports {signed(paper)}" if paper is not None else ""
        entries.append((signed(evaluation["return"]["mean"]), f"return{beside}"))
    if evaluation and evaluation.get("relative_return"):
        relative = percent(evaluation["relative_return"]["mean"])
        entries.append((relative, "of the oracle's return, counted from failure"))
    return entries


def _lead(run: Run) -> str:
    """Return what the page is about, and how that was learned as far as the metrics say."""
    offline, online = (run.stage(name, "updates") for name in ("pretrain", "finetune"))
    learned = ["pretrained offline on recorded episodes"] if offline else []
    if online:
        learned.append(f"{'fine-tuned' if offline else 'trained'} online in simulation")
    said = f" It was {', then '.join(learned)}." if learned else ""
    return f'<p class="lead">{_LEAD}{said}</p>'


def _results(run: Run) -> str:
    known = run.after or run.before
    # As the shell leaves the file of an eisp-eval that has not come to its end.
    left_out = "".join(f" {name} is empty: its eisp-eval has not finished." for name in run.empty)
    if known is None:
        return page.section("Results", "There is no evaluation in this run." + left_out)
    meaning = _FOREIGN if known.get("oracle_return") is None else _OURS
    text = (
        f"Over {known['episodes']} fresh episodes, seeds {known['seed']} and up, none of them "
        f"learned from. {meaning} Brackets: the 95% interval.{left_out}"
    )
    rows = [
        [page.escape(name), *(f"{f.value} <small>{f.interval}</small>" for f in figures)]
        for name, figures in result_rows(run.before, run.after)
    ]
    strong = int(bool(run.before)) if run.after else None
    return page.section("Results", text, page.table(HEAD, rows, strong))


def _video(run: Run) -> str:
    if run.video is None:
        return page.section("An episode", "No film of an episode was made in this run.")
    data = base64.b64encode(run.video).decode()
    poster = base64.b64encode(middle_frame(run.video)).decode()
    text = (
        "Translucent cubes show the subgoal that the policy is heading for, small spheres the goal "
        "of the episode, both in the colours of the objects. It runs at twice the robot's speed."
    )
    film = (
        f'<video controls muted loop playsinline poster="data:image/jpeg;base64,{poster}" '
        f'src="data:video/mp4;base64,{data}"></video>'
    )
    return page.section("An episode", text, film)


def _learning(run: Run) -> str:
    online = run.stage("finetune", "eval/success_last")
    if not online:
        return page.section("Learning", "No evaluation was made while this run was learning.")
    end = max((m["wall_s"] for m in run.metrics if m.get("stage") == "pretrain"), default=0.0)
    # Each stage counts its own seconds.
    minutes = [(end + m["wall_s"]) / 60 for m in online]
    steps = [m["env_steps"] for m in online]
    charts = []
    for x, label, regions in (
        (steps, "environment steps online", []),
        (minutes, "minutes", _regions(end / 60, minutes[-1])),
    ):
        charts += _curves(run, online, x, label, regions)
    text = (
        "Evaluations on seeds of their own while learning, without exploration. "
        + _dip_in_words(online)
    )
    colours = [(_BLUE, "at the last step"), ("#93c5fd", "at any step")]
    if end:
        colours += [(_PRETRAIN, "pretraining, offline"), (_FINETUNE, "fine-tuning, online")]
    return page.section("Learning", text, page.pair(*charts), page.key(colours))


def _regions(pretrained: float, end: float) -> list[Region]:
    if not pretrained:
        return []
    return [
        Region("pretraining", 0.0, pretrained, _PRETRAIN),
        Region("fine-tuning", pretrained, max(end, pretrained), _FINETUNE),
    ]


def _curves(
    run: Run,
    points: Sequence[dict[str, Any]],
    x: Sequence[float],
    label: str,
    regions: Sequence[Region],
) -> list[str]:
    def series(name: str, key: str, colour: str) -> Series:
        return Series(name, x, [p.get(key, math.nan) for p in points], colour)

    known = run.after or run.before or {}
    levels = [
        Level(name, known[key], colour)
        for name, key, colour in (
            ("oracle", "oracle_return", _ORACLE),
            ("the paper", "paper_return", _PAPER),
        )
        if known.get(key) is not None
    ]
    success = [
        series("success at any step", "eval/success_any", "#93c5fd"),
        series("success at the last step", "eval/success_last", _BLUE),
    ]
    return [
        line_chart("Success", label, success, regions=regions, y_range=(0.0, 1.0), percent=True),
        line_chart(
            "Return",
            label,
            [series("return", "eval/return", _TEAL)],
            levels=levels,
            regions=regions,
        ),
    ]


def _dip_in_words(online: Sequence[dict[str, Any]]) -> str:
    from finetune.train import summarise

    curve = [{"env_steps": m["env_steps"], "success_last": m["eval/success_last"]} for m in online]
    facts = summarise(curve)
    first = percent(facts["offline_success"])
    if facts["dip"] <= 0.0:
        return f"Going online did not set the policy back: it started at {first} and stayed above."
    dip = f"Going online first cost {100 * facts['dip']:.0f} points of the {first} at the start; "
    if math.isfinite(facts["recovery_steps"]):
        return dip + f"{facts['recovery_steps']:,.0f} environment steps later it had recovered."
    return dip + "it did not recover in this run."


def _pretraining(run: Run) -> str:
    shares = {
        "held_out/hits": ("within 5 cm of what was reached next", _BLUE),
        "held_out/near_data": ("near an arrangement in the data", _TEAL),
    }
    points = run.stage("pretrain", *shares, "held_out/log_likelihood")
    if not points:
        return ""
    x = [float(p["updates"]) for p in points]

    def series(key: str, name: str, colour: str) -> Series:
        return Series(name, x, [p.get(key, math.nan) for p in points], colour)

    likelihood = series("held_out/log_likelihood", "log-likelihood", _BLUE)
    return page.section(
        "Pretraining",
        "On episodes that were held out: how likely the generator finds the subgoals that were "
        "reached next, and how good its likeliest proposals are.",
        page.pair(
            line_chart("Log-likelihood of subgoals", "updates", [likelihood]),
            line_chart(
                "Share of proposed subgoals",
                "updates",
                [series(k, name, colour) for k, (name, colour) in shares.items()],
                y_range=(0.0, 1.0),
                percent=True,
            ),
        ),
        page.key([(colour, name) for name, colour in shares.values()]),
    )


def _failures(run: Run) -> str:
    known = run.after or run.before or {}
    distance = known.get("subgoal_distance")
    if not distance:
        return page.section("Where it fails", "No distances to subgoals were measured in this run.")
    edges = distance["edges"]
    bars = len(distance["failures"])
    names = [f"{edge:g}" for edge in edges[:bars]]
    if bars == len(edges):  # the last range is open
        names[-1] = f"≥{names[-1]}"
    chart = bar_chart(
        "Episodes",
        "distance to the last subgoal, m (lower end of each range)",
        names,
        [("failed", distance["failures"], _RED), ("successful", distance["successes"], _BLUE)],
    )
    text = (
        "How far the last subgoal of each episode was from what was achieved in the end, as in "
        "the paper's failure analysis. Failures at short distances are subgoals that led nowhere; "
        "those at long ones could not be reached."
    )
    colours = page.key([(_RED, "failed"), (_BLUE, "successful")])
    return page.section("Where it fails", text, page.pair(chart), colours)


def _configuration(run: Run) -> str:
    if not run.configs:
        return page.section("Configuration", "No configuration was saved with this run.")
    text = "All settings as they were used; give a file back with --config to repeat the stage."
    return page.section(
        "Configuration", text, *(page.details(n, t) for n, t in run.configs.items())
    )
