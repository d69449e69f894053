"""``eisp-eval``: how good a policy is, with intervals."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from eisp_data.cli.run import fail, run
from eisp_data.cli.words import take
from eisp_data.errors import EispError
from finetune.config import EvaluateConfig, PolicyConfig
from pretrain.saved import saved_subgoals

if TYPE_CHECKING:
    from finetune.evaluate import Evaluation


def main() -> None:
    """Run the command."""
    try:
        _, path = take(sys.argv[1:], "--policy.path")
        default = EvaluateConfig(PolicyConfig())
        if path is not None:
            folder = Path(path)
            default = EvaluateConfig(PolicyConfig(folder), subgoals=saved_subgoals(folder))
    except EispError as error:
        fail(str(error))
    run(_command, None, "eisp-eval", default=default)


def _command(config: EvaluateConfig) -> None:
    """Evaluate a policy over fresh episodes."""
    from finetune.assess import assess

    result = assess(config)
    print(json.dumps(result.to_plain(), indent=2) if config.json else table(result))


def table(result: Evaluation) -> str:
    """Return the figures as text, each with its 95% interval."""
    rows = {
        "success at the last step": result.success_last,
        "  and at rest, let go of": result.success_settled,
        "success at any step": result.success_any,
        "return": result.return_,
        "return relative to the oracle": result.relative_return,
        "return of the oracle": result.oracle_return,
        "return in the paper": result.paper_return,
    }
    lines = [f"{result.task}: {result.episodes} episodes from seed {result.seed}"]
    lines += [f"{name:32}{value}" for name, value in rows.items() if value is not None]
    failures = _histogram(result.subgoal_distance.edges, result.subgoal_distance.failures)
    lines.append(f"{'failures by m to the subgoal':32}{failures}")
    return "\n".join(lines)


def _histogram(edges: tuple[float, ...], counts: tuple[int, ...]) -> str:
    pairs = zip(edges, counts, strict=True)
    return "  ".join(f"from {edge}: {count}" for edge, count in pairs if count) or "none"
