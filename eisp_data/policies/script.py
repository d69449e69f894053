"""Scripted policies: keyframes that a generator yields while it watches its world.

A script is an ordinary Python generator. It reads the live ``View`` of its world, yields the next
``Keyframe``, and goes on when the gripper is there::

    def touch(view: View, aim: Aim) -> Iterator[Keyframe]:
        yield Keyframe(view.blocks[0] + [0, 0, 0.08], OPEN)

The same script makes the oracle (no noise, the whole task) and the collector's demonstrations
(noise, a random part of the task).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from eisp_data.tasks.base import ACTION_SCALE_M, Task

OPEN, CLOSED = 1.0, -1.0
_BLUNDER_M = 0.06
_LEAST_EFFORT = 0.25
_RISE_M = 0.04


@dataclass(frozen=True)
class Keyframe:
    """Where the gripper goes next, and with which fingers."""

    position: np.ndarray
    """(3,) m, of the point between the fingertips."""
    fingers: float
    """OPEN or CLOSED."""
    tolerance_m: float = 0.008
    hold_steps: int = 0
    """Steps to stay once there, while the fingers move."""
    most_steps: int = 25
    """Steps after which the script goes on wherever the gripper is."""


@dataclass(frozen=True)
class Noise:
    """What separates a demonstration from the oracle."""

    action_std: float = 0.0
    """Standard deviation of the Gaussian added to a displacement at full speed; it shrinks with
    the displacement to a quarter, as human movements are noisiest when fastest (Harris and
    Wolpert 1998)."""
    aim_std_m: float = 0.0
    """Standard deviation of the places that a script aims at, drawn anew for each."""
    blunder: float = 0.0
    """Probability that an object is brought to a place up to 6 cm off in x and in y. What the
    script then does about it is what a policy has to know in order to recover."""
    slowest: float = 1.0
    """Each episode moves at a share of full speed drawn from [slowest, 1]."""
    stumble: float = 0.0
    """Probability, per step, that the gripper goes astray for two to six steps: in some direction
    and, half of the time, with its fingers the other way. It may end up on top of a block, and
    the script has to find its way out of there."""
    partial: bool = False
    """Whether the script does a random part of the task only (a random level of the goal)."""
    whole_share: float = 0.05
    """Share of the partial scripts that attempt the whole task all the same."""
    least_s: float = 4.0
    """A partial script that is done earlier goes on with parts at places of its own; 4 s are the
    100 steps of the shortest trajectories in the paper's appendix."""


class View:
    """One world, as its script sees it: privileged information, always current."""

    def __init__(self, task: Task, states: np.ndarray, row: int, goal: np.ndarray) -> None:
        self._task = task
        self.states = states
        self._row = row
        self.goal = goal.reshape(-1, 3)
        """(objects, 3) m, the desired positions."""

    @property
    def _state(self) -> np.ndarray:
        return self.states[self._row : self._row + 1]

    @property
    def time_s(self) -> float:
        """Seconds since the reset."""
        return float(self._state[0, 0])

    @property
    def gripper(self) -> np.ndarray:
        """(3,) m."""
        return self._task.qpos(self._state)[0, :3].copy()

    @property
    def blocks(self) -> np.ndarray:
        """(blocks, 3) m."""
        return self._task.block_positions(self._state)[0].copy()

    @property
    def objects(self) -> np.ndarray:
        """(objects, 3) m, the achieved goal."""
        return self._task.achieved_goal(self._state)[0].reshape(-1, 3).astype(float)


@dataclass
class Aim:
    """The randomness of one episode's script."""

    rng: np.random.Generator
    noise: Noise

    def at(self, position: np.ndarray) -> np.ndarray:
        """Return the position as this demonstrator hits it: displaced in the plane."""
        miss = np.clip(self.rng.normal(0.0, 1.0, 2), -3.0, 3.0) * self.noise.aim_std_m
        return position + np.append(miss, 0.0)

    def destination(self, position: np.ndarray) -> np.ndarray:
        """Return where this demonstrator brings what belongs at the position."""
        if self.noise.blunder and self.rng.random() < self.noise.blunder:
            miss = self.rng.uniform(-_BLUNDER_M, _BLUNDER_M, 2)
            return position + np.append(miss, 0.0)
        return self.at(position)


Script = Callable[[View, Aim], Iterator[Keyframe]]


class _Actor:
    """One world's script in progress."""

    def __init__(self, script: Script, view: View, aim: Aim) -> None:
        self.view, self.aim = view, aim
        self.speed = aim.rng.uniform(aim.noise.slowest, 1.0)
        self.frames = script(view, aim)
        self.frame = Keyframe(view.gripper, OPEN)
        self.finished = False
        self._ways_back: list[Keyframe] = []
        self._stumble: _Stumble | None = None
        self._steps = self._held = 0
        self._next()

    def _next(self) -> None:
        self._steps = self._held = 0
        frame = next(self.frames, None)
        if frame is None:
            self.finished = True
        else:
            self.frame = frame

    def act(self) -> np.ndarray:
        """Return the action (4,) towards the current keyframe."""
        gripper = self.view.gripper
        if self._astray(gripper):
            assert self._stumble is not None
            fingers = self.frame.fingers * self._stumble.fingers
            return self._noisy(self._stumble.direction, fingers)
        frame = self._ways_back[0] if self._ways_back else self.frame
        if self._ways_back or not self.finished:
            tolerance = frame.tolerance_m
            tolerance += _LEAST_EFFORT * self.aim.noise.action_std * ACTION_SCALE_M
            there = np.linalg.norm(frame.position - gripper) <= tolerance
            over = (there and self._held >= frame.hold_steps) or self._steps >= frame.most_steps
            if over and self._ways_back:
                self._ways_back.pop(0)
                self._steps = self._held = 0
            elif over:
                self._next()
                frame = self.frame
            self._held += bool(there)
            self._steps += 1
        return self._noisy((frame.position - gripper) / ACTION_SCALE_M, frame.fingers)

    def _astray(self, gripper: np.ndarray) -> bool:
        """Begin, go on with or end a stumble; after one, rise and go back over where it began."""
        noise, rng = self.aim.noise, self.aim.rng
        if self._stumble is None:
            if not noise.stumble or self._ways_back or rng.random() >= noise.stumble:
                return False
            self._stumble = _Stumble(
                start=gripper,
                direction=rng.uniform(-1.0, 1.0, 3),
                fingers=float(rng.choice([-1.0, 1.0])),
                steps=int(rng.integers(2, 7)),
            )
        self._stumble.steps -= 1
        if self._stumble.steps >= 0:
            return True
        start, self._stumble = self._stumble.start, None
        height = max(start[2], gripper[2]) + _RISE_M
        self._ways_back = [
            Keyframe(np.append(place[:2], height), self.frame.fingers, tolerance_m=0.02)
            for place in (gripper, start)
        ]
        self._steps = self._held = 0
        return False

    def _noisy(self, displacement: np.ndarray, fingers: float) -> np.ndarray:
        noise, rng = self.aim.noise, self.aim.rng
        action = np.append(np.clip(displacement, -self.speed, self.speed), fingers)
        if noise.action_std:
            effort = max(_LEAST_EFFORT, float(np.abs(action[:3]).max()))
            action += rng.normal(0.0, noise.action_std * effort, 4)
        return np.clip(action, -1.0, 1.0)


@dataclass
class _Stumble:
    """The gripper gone astray."""

    start: np.ndarray
    """(3,) m, where it was."""
    direction: np.ndarray
    """(3,) displacement of the action."""
    fingers: float
    """-1 if the fingers do the opposite of what the script wants, else 1."""
    steps: int
    """Still to go."""


class ScriptedPolicy:
    """One script played in each world of a batch."""

    def __init__(self, task: Task, script: Script, noise: Noise, worlds: int) -> None:
        self._task, self._script, self._noise = task, script, noise
        self._actors: list[_Actor | None] = [None] * worlds

    def begin(self, world: int, state: np.ndarray, goal: np.ndarray, seed: int) -> None:
        """Start the script of one world; ``state`` is the (N, P) batch, ``goal`` (G,)."""
        # A stream of its own: the world's start and its demonstrator share the seed.
        aim = Aim(np.random.default_rng([seed, 1]), self._noise)
        view = View(self._task, state, world, goal)
        self._actors[world] = _Actor(self._script, view, aim)

    def act(self, state: np.ndarray) -> np.ndarray:
        """Return (N, 4) float32 actions in the (N, P) states; zeros where no script has begun."""
        action = np.zeros((len(state), 4), np.float32)
        for world, actor in enumerate(self._actors):
            if actor is not None:
                actor.view.states = state
                action[world] = actor.act()
        return action

    @property
    def finished(self) -> np.ndarray:
        """(N,) bool: the script has come to its end."""
        return np.array([actor is None or actor.finished for actor in self._actors])
