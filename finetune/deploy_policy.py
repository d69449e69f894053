"""A trained policy in charge of a robot: the rollout of training, and a look after each subgoal."""

from __future__ import annotations

import numpy as np
import torch

from eisp_data.robots.look import FRESH_S
from eisp_data.robots.record_controllers import Decision
from eisp_data.robots.session_view import Seen
from eisp_data.tasks.base import Task, is_success
from finetune.rollout import SubgoalPolicy
from pretrain.agent import Agent

_SHORTEST_STEPS = 10
"""A subgoal that is reached sooner, because it was all but reached before, is worth no look."""
_CLINGING_STEPS = 25
"""What is at its goal and has been held there for so long is let go of."""
_SURPRISE_M = 0.01
"""A look that shows an object this far from where it was believed to be calls for a new plan."""
_CLEAR_M = 0.05
"""An arm that is this far from all objects is in the middle of no push and no pull."""
_HIDDEN_STEPS = 5
"""What is at its goal but has been out of sight for so long is looked at: it may be gone."""
_DONE_STEPS = 3
"""It has done with them once that has been so for so many steps."""
_TAKEN_M = 0.03
"""An object that moves so far within a step while the arm is clear of it was moved by somebody."""
_STALLED_STEPS, _STILL_M = 40, 0.025
"""A policy that for so many steps has moved neither the arm nor an object further has come to a
standstill, or goes to and fro between two subgoals."""


class PolicyController:
    """``SubgoalPolicy`` in one world, which is the real one.

    Attributes:
        at_subgoal: whether the subgoal of the last step was reached when this one began.
    """

    def __init__(self, agent: Agent) -> None:
        self.name = "eisp"
        self._rollout = SubgoalPolicy(agent, 1)
        self._goal = np.empty(0)
        self._begun = self.at_subgoal = False

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Forget the last episode."""
        # The same seed gives the same episode, however many there were before.
        torch.manual_seed(seed)
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
        action = self._rollout.act(seen.observation[None], achieved, self._goal[None])[0]
        return Decision(action.astype(float), subgoal=self._rollout.subgoal[0].copy())


class Looking:
    """Asks for a look at the table after each subgoal, once the arm has let go and come away.

    Where the look shows something else than was believed, the policy plans anew. It does so, too,
    as soon as somebody moves an object, and after a look that was asked for because nothing went
    on.
    """

    def __init__(self, inner: PolicyController, task: Task) -> None:
        self.name = inner.name
        self._inner, self._task = inner, task
        self._done = self._since = self._clung = self._hidden = 0
        self._due, self._goal = False, np.empty(0)
        self._believed: np.ndarray | None = None
        self._places: np.ndarray = np.empty(0)
        self._still = 0
        self._last: np.ndarray | None = None

    def begin(self, seen: Seen, goal: np.ndarray, seed: int) -> None:
        """Start an episode."""
        self._due, self._goal, self._believed, self._last = False, goal, None, None
        self._done = self._since = self._clung = self._hidden = self._still = 0
        self._inner.begin(seen, goal, seed)

    def act(self, seen: Seen) -> Decision:
        """Return the policy's action, or that it is time for a look."""
        if self._believed is not None:
            if np.abs(seen.achieved_goal - self._believed).max() > _SURPRISE_M:
                self._inner.replan()
            self._believed = None
        if self._is_taken(seen):
            self._inner.replan()
        decision = self._inner.act(seen)
        self._since += 1
        self._due |= self._inner.at_subgoal and self._since >= _SHORTEST_STEPS
        state = seen.state[None]
        hands_off = self._task.fingers_closed or bool(self._task.hands_off(state)[0])
        away = np.linalg.norm(seen.achieved_goal.reshape(-1, 3) - seen.gripper_m, axis=1)
        done = bool(self._task.settled(state)[0]) and away.min() > _CLEAR_M
        self._done = self._done + 1 if done else 0
        met = bool(is_success(seen.achieved_goal, self._goal))
        self._clung = self._clung + 1 if met and not hands_off else 0
        clings = self._clung >= _CLINGING_STEPS
        unsure = met and hands_off and seen.age_s > FRESH_S
        self._hidden = self._hidden + 1 if unsure else 0
        hides = self._hidden >= _HIDDEN_STEPS
        stalls = self._stalls(seen)
        looks = self._due and self._done >= _DONE_STEPS
        if not (clings or hides or stalls or looks):
            return decision
        if clings or stalls:
            self._inner.replan()
        self._due, self._last = False, None
        self._since = self._clung = self._hidden = self._still = 0
        self._believed = seen.achieved_goal.copy()
        return Decision(np.zeros(4), looking=True)

    def _is_taken(self, seen: Seen) -> bool:
        """Return whether somebody has moved an object since the last step."""
        places = seen.achieved_goal.reshape(-1, 3)
        before, self._last = self._last, places
        if before is None:
            return False
        moved = np.linalg.norm(places - before, axis=1) > _TAKEN_M
        clear = np.linalg.norm(before - seen.gripper_m, axis=1) > _CLEAR_M
        return bool((moved & clear).any())

    def _stalls(self, seen: Seen) -> bool:
        """Return whether arm and objects have stayed where they are for too long."""
        places = np.vstack([seen.gripper_m, seen.achieved_goal.reshape(-1, 3)])
        if not self._still or np.linalg.norm(places - self._places, axis=1).max() > _STILL_M:
            self._places, self._still = places, 0
        self._still += 1
        return self._still > _STALLED_STEPS
