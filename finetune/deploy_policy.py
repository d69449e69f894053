"""A trained policy in charge of a robot: the rollout of training, and a look after each subgoal."""

from __future__ import annotations

import numpy as np

from eisp_data.robots.record_controllers import Decision
from eisp_data.robots.session_view import Seen
from eisp_data.tasks.base import ACTION_SCALE_M, Task, is_success
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent

LOOK_FROM_M = (0.22, 0.0, 0.26)
"""Where the gripper waits while the camera, opposite the arm, sees the table."""
_READY_M = (0.29, 0.0, 0.17)
"""Where it goes on from: among the places at which episodes begin in training."""
_LEAVE_SPEED = 0.5
_LEAVE_UP_M = 0.08
"""It first rises by this, so that nothing is knocked over."""
_NEAR_M = 0.02
_LONGEST_LEG_STEPS = 40
_FRESH_S = 0.15
_LONGEST_LOOK_STEPS = 25
_SHORTEST_STEPS = 10
"""A subgoal that is reached sooner, because it was all but reached before, is worth no look."""
_CLINGING_STEPS = 25
"""What is at its goal and has been held there for so long is let go of."""
_OPEN_M = 0.06
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
    """Withdraws the arm after each subgoal, once it has let go, so that the camera sees all.

    The paper: "the robot arm is reset to a specific pose to observe the current state after
    achieving each subgoal". Then the policy plans anew from what was seen.
    """

    def __init__(self, inner: PolicyController, task: Task) -> None:
        self.name = inner.name
        self._inner, self._task = inner, task
        self._legs: list[np.ndarray] = []
        self._steps = self._off = self._since = self._clung = 0
        self._due, self._goal = False, np.empty(0)

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start an episode."""
        self._legs, self._due, self._goal = [], False, goal
        self._steps = self._off = self._since = self._clung = 0
        self._inner.begin(seen, goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the policy's action, or one that leads out of the camera's way."""
        if self._legs:
            return self._leave(seen)
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
        here = seen.gripper_m
        up = np.array([here[0], here[1], max(here[2] + _LEAVE_UP_M, LOOK_FROM_M[2])])
        self._legs = [up, np.array(LOOK_FROM_M), np.array(_READY_M)]
        self._steps = 0
        return self._leave(seen)

    def _leave(self, seen: Seen) -> Decision:
        """Let go, go on along the way out, look, and come back."""
        closed = self._task.fingers_closed
        fingers = -1.0 if closed else 1.0
        opening = seen.estimates.tool.opening_m
        if not closed and opening < _OPEN_M and self._steps < _LONGEST_LEG_STEPS:
            self._steps += 1
            return Decision(np.array([0.0, 0.0, 0.0, fingers]), looking=True)
        way = self._legs[0] - seen.gripper_m
        there = np.linalg.norm(way) < _NEAR_M or self._steps >= _LONGEST_LEG_STEPS
        looks = len(self._legs) == 2
        waits = looks and there and seen.age_s > _FRESH_S
        self._steps += 1
        if there and not (waits and self._steps < _LONGEST_LEG_STEPS + _LONGEST_LOOK_STEPS):
            self._legs.pop(0)
            self._steps = 0
            if not self._legs:
                self._inner.replan()
                return self.act(seen)
        motion = np.clip(way / ACTION_SCALE_M, -_LEAVE_SPEED, _LEAVE_SPEED)
        return Decision(np.append(motion, fingers), looking=True)
