"""Settings that cannot be used, told in one line before anything is read or written."""

from __future__ import annotations

from eisp_data.config import above_zero, at_least, check_seed, zero_to_one
from eisp_data.errors import ConfigError
from pretrain.config import GoalMix, PretrainConfig, SubgoalConfig

_ROUNDING = 1e-8
"""What ``numpy.random.Generator.choice`` allows."""


def check_pretrain(config: PretrainConfig) -> None:
    """Raise ConfigError unless the settings can be used."""
    check_seed(config.seed)
    at_least(
        1,
        {
            "--updates": config.updates,
            "--batch-size": config.batch_size,
            "--generator-every": config.generator_every,
            "--generator-batch-size": config.generator_batch_size,
            "--validate-every": config.validate_every,
            "--threads": config.threads,
            "--agent.waypoints": config.agent.waypoints,
            "--agent.mix.horizon": config.agent.mix.horizon,
            "--agent.movers.width": config.agent.movers.width,
            "--agent.movers.modes": config.agent.movers.modes,
        },
    )
    for flag, layers in (
        ("--agent.sac.layers", config.agent.sac.layers),
        ("--agent.hybrid.layers", config.agent.hybrid.layers),
    ):
        if not layers or min(layers) < 1:
            raise ConfigError(f"{flag} must be one or more sizes of at least 1; got {layers}")
    above_zero(
        {
            "--agent.sac.lr": config.agent.sac.lr,
            "--generator-lr": config.generator_lr,
            "--agent.sac.tau": config.agent.sac.tau,
            "--agent.mix.tolerance-m": config.agent.mix.tolerance_m,
        }
    )
    at_least(
        0,
        {
            "--agent.sac.alpha": config.agent.sac.alpha,
            "--agent.sac.cloning": config.agent.sac.cloning,
            "--agent.hybrid.beta": config.agent.hybrid.beta,
            "--agent.movers.likelihood": config.agent.movers.likelihood,
            "--agent.movers.reconstruction": config.agent.movers.reconstruction,
            "--agent.movers.divergence": config.agent.movers.divergence,
            "--agent.movers.temperature": config.agent.movers.temperature,
            "--agent.mix.errors": config.agent.mix.errors,
        },
    )
    zero_to_one(
        {
            "--agent.sac.tau": config.agent.sac.tau,
            "--agent.mix.complete": config.agent.mix.complete,
            "--agent.mix.furthest": config.agent.mix.furthest,
            "--final-lr-share": config.final_lr_share,
            "--generator-final-lr-share": config.generator_final_lr_share,
        }
    )
    if not 0 < config.validation_share < 1:
        raise ConfigError(
            f"--validation-share must be between 0 and 1; got {config.validation_share}"
        )
    if not 0 <= config.agent.sac.gamma < 1:
        raise ConfigError(
            f"--agent.sac.gamma must be at least 0 and below 1; got {config.agent.sac.gamma}"
        )
    _check_mix(config.agent.mix)
    check_subgoals(config.agent.subgoals, "--agent.subgoals")


def check_subgoals(config: SubgoalConfig, flag: str) -> None:
    """Raise ConfigError unless subgoals can be chosen so; the options are under ``flag``."""
    at_least(
        1, {f"{flag}.candidates": config.candidates, f"{flag}.every-steps": config.every_steps}
    )
    at_least(0, {f"{flag}.reached-m": config.reached_m, f"{flag}.final-m": config.final_m})


def _check_mix(mix: GoalMix) -> None:
    parts = mix.waypoint, mix.future, mix.displaced, mix.pursued
    if min(parts) < 0 or not abs(sum(parts) - 1) <= _ROUNDING:
        said = ", ".join(map(str, parts))
        raise ConfigError(
            "--agent.mix: the shares of waypoint, future, displaced and pursued goals must be at "
            f"least 0 and add up to 1; got {said}"
        )
