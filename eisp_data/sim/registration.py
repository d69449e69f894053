"""The Gymnasium ids of the tasks. Light: it runs whenever the package is imported."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

from eisp_data.tasks import paper

# Not read off the task registry, which compiles scenes; a test compares the two.
ENV_IDS = {
    "stack": "eisp/Stack-v0",
    "push4": "eisp/Push4-v0",
    "open_drawer": "eisp/OpenDrawer-v0",
    "store": "eisp/Store-v0",
}
"""Task name to Gymnasium id."""

_SETTINGS = {
    "stack": paper.STACK,
    "push4": paper.PUSH4,
    "open_drawer": paper.OPEN_DRAWER,
    "store": paper.STORE,
}


def register_envs() -> None:
    """Make ``gymnasium.make("eisp/Stack-v0")`` and its like work; call it as often as you like."""
    for name, env_id in ENV_IDS.items():
        if env_id not in registry:
            register(
                env_id,
                entry_point="eisp_data.sim.env:TaskEnv",
                max_episode_steps=_SETTINGS[name].episode_steps,
                kwargs={"task": name},
            )
