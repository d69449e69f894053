"""Who decides where the gripper goes: a human, a script, or one of them watched by a human."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from eisp_data.policies.registry import SCRIPTS
from eisp_data.policies.script import Noise, ScriptedPolicy
from eisp_data.robots.look import opening_action
from eisp_data.robots.session_view import Seen
from eisp_data.robots.teleop import Teleop
from eisp_data.tasks.base import Task


@dataclass(frozen=True)
class Decision:
    """What to do in one tick."""

    action: np.ndarray
    """(4,) in [-1, 1], as the task's: displacement of the gripper, and its opening."""
    subgoal: np.ndarray | None = None
    """(G,) m, what the action is meant to lead to."""
    outcome: str | None = None
    """Ends the episode: one of ``messages.OUTCOMES``."""
    by_human: bool = False
    """A human has taken over from a script or a policy."""
    looking: bool = False
    """Of a controller: what it needs next is a look at the table, not this action. Of a session:
    the arm is getting out of the camera's way, or back from there."""


class Controller(Protocol):
    """Decides, tick by tick."""

    name: str

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start an episode towards the goal (G,)."""

    def act(self, seen: Seen) -> Decision:
        """Return what to do now."""


class Human:
    """Somebody at a keyboard or a gamepad."""

    def __init__(self, teleop: Teleop, speed: float) -> None:
        """``speed`` is the share of the fastest displacement that a full deflection gives."""
        self.name: str = teleop.device
        self._teleop, self._speed = teleop, speed
        self._fingers = 1.0

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Take the fingers as they are."""
        self._fingers = opening_action(seen.estimates.tool.opening_m)

    def go_on_from(self, fingers: float) -> None:
        """Start from the last command to the fingers; where they are would not squeeze."""
        self._fingers = fingers

    def act(self, seen: Seen) -> Decision:
        """Return what the hands say; RobotError if the device is gone."""
        return self.decide()[0]

    def decide(self) -> tuple[Decision, bool]:
        """Return what the hands say, and whether they want to take over."""
        grip = self._teleop.read()
        if grip.fingers is not None:
            self._fingers = grip.fingers
        action = np.append(self._speed * grip.motion, self._fingers)
        return Decision(action, outcome=grip.outcome), grip.takes_over


class Script:
    """The task's scripted policy, on what is perceived instead of what is true."""

    def __init__(self, task: Task) -> None:
        self.name = "script"
        self._policy = ScriptedPolicy(task, SCRIPTS[task.name], Noise(), worlds=1)

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start the script anew."""
        self._policy.begin(0, seen.state[None], goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the action towards the current keyframe."""
        return Decision(self._policy.act(seen.state[None])[0])


class Watched:
    """A controller that a human may take over from at any moment."""

    def __init__(self, inner: Slowed, human: Human) -> None:
        self.name = inner.name
        self._inner, self._human = inner, human

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start both."""
        self._inner.begin(seen, goal, seed)
        self._human.begin(seen, goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the human's decision while the controls are held, else the other's."""
        hands, takes_over = self._human.decide()
        if takes_over:
            self._inner.interrupt()
            return replace(hands, by_human=True)
        decision = self._inner.act(seen)
        # A look ends with open fingers.
        self._human.go_on_from(1.0 if decision.looking else float(decision.action[3]))
        return replace(decision, outcome=hands.outcome or decision.outcome)


class Slowed:
    """A controller that was made for a faster arm: it acts once in several ticks.

    To it time passes that much slower: it is shown speeds so many times as high, and each of its
    displacements takes so many ticks. UR3's joints turn at up to 3.1 rad/s, which is not always
    1 m/s at the fingers; a policy that was trained at that speed is right again at half of it.
    """

    def __init__(self, inner: Controller, task: Task, ticks: int) -> None:
        self.name = inner.name
        self._inner, self._task, self._ticks = inner, task, ticks
        self._start_s, self._step = 0.0, 0
        self._decision = Decision(np.zeros(4))

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start the controller's clock."""
        self._start_s, self._step = seen.at_s, 0
        self._inner.begin(self._stretched(seen), goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return a part of what the controller decides."""
        if self._step % self._ticks == 0:
            decision = self._inner.act(self._stretched(seen))
            action = decision.action.copy()
            action[:3] /= self._ticks
            self._decision = replace(decision, action=action)
        # After a look it decides anew.
        self._step = 0 if self._decision.looking else self._step + 1
        return self._decision

    def interrupt(self) -> None:
        """Decide anew at the next tick: somebody else moves the arm."""
        self._step = 0

    def _stretched(self, seen: Seen) -> Seen:
        state = seen.state.copy()
        state[0] = self._start_s + (state[0] - self._start_s) / self._ticks
        self._task.qvel(state)[:] *= self._ticks
        return replace(seen, state=state, observation=self._task.observe(state[None])[0])


class Limited:
    """Ends the episode once the task's L steps have been taken; a look is none."""

    def __init__(self, inner: Controller, steps: int) -> None:
        self.name = inner.name
        self._inner, self._most, self._taken = inner, steps, 0

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start to count."""
        self._taken = 0
        self._inner.begin(seen, goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the other's decision, or the end."""
        decision = self._inner.act(seen)
        self._taken += not decision.looking
        return replace(decision, outcome="timeout") if self._taken > self._most else decision
