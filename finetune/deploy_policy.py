"""A trained policy in charge of a robot: the rollout of training, and a look after each subgoal."""

from __future__ import annotations

import numpy as np

from eisp_data.robots.record_controllers import Decision
from eisp_data.robots.session_view import Seen
from eisp_data.tasks.base import Task, is_success
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent

_SHORTEST_STEPS = 10
"""A subgoal that is reached sooner, because it was all but reached before, is worth no look."""
_CLINGING_STEPS = 25
"""What is at its goal and has been held there for so long is let go of."""
_OFF_STEPS = 3
"""Hands are off once they have been for so many steps."""


class PolicyController:
    """``SubgoalPolicy`` in one world, which is the real one.

    Attributes:
        at_subgoal: whether the subgoal of the last step was reached when this one began.
    """

    def __init__(self, agent: Agent, device: str = "cpu") -> None:
        self.name = "eisp"
        self._rollout = SubgoalPolicy(agent, 1, device)
        self._goal = np.empty(0)
        self._begun = self.at_subgoal = False

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Forget the last episode."""
        self._goal, self._begun = goal, False
        self._rollout.reset(np.array([0]))

    def replan(self) -> None:
        """Choose a new subgoal at the next step."""
        self._begun = False
        self._rollout.reset(np.array([0]))

    def act(self, seen: Seen) -> Decision:
        """Return the policy's action, without exploration."""
        achieved = seen.achieved_goal[None]
        self.at_subgoal = self._begun and bool(self._rollout.reached(achieved)[0])
        self._begun = True
        action = self._rollout.act(
            seen.observation[None], achieved, self._goal[None], explore=False
        )[0]
        return Decision(action.astype(float), subgoal=self._rollout.subgoal[0].copy())


class Looking:
    """Asks for a look at the table after each subgoal, once the fingers have let go.

    Then the policy plans anew from what was seen.
    """

    def __init__(self, inner: PolicyController, task: Task) -> None:
        self.name = inner.name
        self._inner, self._task = inner, task
        self._off = self._since = self._clung = 0
        self._due, self._goal = False, np.empty(0)

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start an episode."""
        self._due, self._goal = False, goal
        self._off = self._since = self._clung = 0
        self._inner.begin(seen, goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the policy's action, or that it is time for a look."""
        decision = self._inner.act(seen)
        self._since += 1
        self._due |= self._inner.at_subgoal and self._since >= _SHORTEST_STEPS
        hands_off = self._task.fingers_closed or bool(self._task.hands_off(seen.state[None])[0])
        self._off = self._off + 1 if hands_off else 0
        met = bool(is_success(seen.achieved_goal, self._goal))
        self._clung = self._clung + 1 if met and not hands_off else 0
        if self._clung < _CLINGING_STEPS and not (self._due and self._off >= _OFF_STEPS):
            return decision
        self._due, self._since, self._clung = False, 0, 0
        self._inner.replan()
        return Decision(np.zeros(4), looking=True)
