"""The oracle's subgoals: the upper bound for a subgoal generator, and the oracle's return."""

from __future__ import annotations

import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import OPEN, Noise, ScriptedPolicy
from eisp_data.sim.gym_worlds import AnyWorlds
from eisp_data.sim.worlds import Worlds
from eisp_data.tasks.registry import TASKS
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent
from pretrain.hindsight import at_rest

_LETTING_GO = np.array([[0, 0, 0, OPEN]] * 4 + [[0, 0, 1, OPEN]] * 2, np.float32)
"""A script expects nothing in the gripper that begins it."""
_NEARER_M = 0.01
_LOOKAHEAD_STEPS = 80
"""Longer than any script takes for one move."""


class OracleSubgoals(SubgoalPolicy):
    """Heads for what the noise-free script would have achieved after its next move.

    The script goes on from the simulator's own state in a copy of the world, so that its subgoals
    are right whatever has happened before.
    """

    def __init__(self, agent: Agent, worlds: AnyWorlds) -> None:
        super().__init__(agent, worlds.count)
        if not isinstance(worlds, Worlds) or worlds.name not in SCRIPTS or agent.vision:
            raise ConfigError(
                f"--subgoals.source oracle: {worlds.name} has no scripted policy, or none that "
                "sees images; choose generator, random or none"
            )
        self._worlds = worlds
        self._physics = worlds.task.physics()

    def _choose(
        self,
        renew: np.ndarray,
        observation: np.ndarray,
        achieved_goal: np.ndarray,
        desired_goal: np.ndarray,
    ) -> np.ndarray:
        task, state = self._worlds.task, self._worlds.state[renew]
        script = ScriptedPolicy(task, SCRIPTS[task.name], Noise(), len(renew))
        for row, world in enumerate(renew):
            script.begin(row, state, desired_goal[row], seed=int(world))
        achieved = [achieved_goal]
        for action in (*_LETTING_GO, *[None] * _LOOKAHEAD_STEPS):
            actions = script.act(state) if action is None else np.tile(action, (len(renew), 1))
            state = self._physics.step(state, task.control(state, actions))
            achieved.append(task.achieved_goal(state))
        paths = np.stack(achieved, axis=1)
        return np.stack([_first(*both) for both in zip(paths, desired_goal, strict=True)])


def _first(path: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the first arrangement at rest that is nearer to the goal than the start of the path.

    If there is none, the first at all: something has to go out of the way. What is nearer comes
    before that, for what is being carried at the start falls out of the gripper.
    """
    rests = path[at_rest(path)[0]]
    if not len(rests):
        return goal
    way = np.linalg.norm(rests - goal, axis=1)
    nearer = np.flatnonzero(way < np.linalg.norm(path[0] - goal) - _NEARER_M)
    return rests[nearer[0] if len(nearer) else 0]


def subgoal_policy(agent: Agent, worlds: AnyWorlds) -> SubgoalPolicy:
    """Return the policy whose subgoals come from where the agent's settings say."""
    if agent.config.subgoals.source == "oracle":
        return OracleSubgoals(agent, worlds)
    return SubgoalPolicy(agent, worlds.count)


def oracle_return(name: str, episodes: int, seed: int) -> float | None:
    """Return the mean return of the noise-free script on these seeds; None if there is none."""
    if name not in SCRIPTS:
        return None
    task = TASKS[name]
    worlds = Worlds(task, episodes)
    worlds.reset(range(seed, seed + episodes))
    policy = ScriptedPolicy(task, SCRIPTS[name], Noise(), episodes)
    for world in range(episodes):
        policy.begin(world, worlds.state, worlds.desired_goal[world], seed + world)
    total = 0.0
    for _ in range(worlds.episode_steps):
        worlds.step(policy.act(worlds.state))
        total += float((worlds.success - 1.0).sum())
    return total / episodes
