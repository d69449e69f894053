"""An evaluation from its configuration, and a film of its first episode."""

from __future__ import annotations

import sys

from eisp_data.config import at_least, check_seed
from eisp_data.errors import ConfigError
from eisp_data.seeds import check_unlearned
from eisp_data.storage.files import check_writable, one_line
from eisp_data.tasks.images import state_task
from eisp_data.tasks.registry import TASKS
from finetune.config import EvaluateConfig
from finetune.evaluate import Evaluation, evaluate
from finetune.oracle import oracle_return
from finetune.run import load_for_rollouts, make_worlds
from finetune.video import Film
from pretrain.checks import check_subgoals
from pretrain.device import set_up

_ORACLE_EPISODES = 100
_BATCH = 100


def assess(config: EvaluateConfig) -> Evaluation:
    """Evaluate a policy, and film its first episode if asked to and if this machine can."""
    at_least(1, {"--episodes": config.episodes, "--threads": config.threads})
    check_seed(config.seed)
    check_unlearned(config.seed, config.episodes)
    check_subgoals(config.subgoals, "--subgoals")
    device = set_up(config.device, config.threads)
    agent = load_for_rollouts(config.policy.path, config.subgoals, device)
    name = agent.config.task
    if config.video:
        if name not in TASKS:
            raise ConfigError(f"--video: only our own tasks are drawn, not {name!r}")
        check_writable(config.video, "--video")
    film = Film()
    result = evaluate(
        agent,
        make_worlds(agent, min(_BATCH, config.episodes)),
        config.episodes,
        config.seed,
        oracle=oracle_return(state_task(name), min(_ORACLE_EPISODES, config.episodes), config.seed),
        watch=film if config.video else None,
    )
    if config.video:
        try:
            film.write(config.video)
        except Exception as error:  # no OpenGL, a full disk: no reason to lose the figures
            print(f"no film: {one_line(error)}", file=sys.stderr)
    return result
