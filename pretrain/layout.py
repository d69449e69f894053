"""How the observation and the goal of an environment are laid out, as far as learning needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from torch import Tensor

from eisp_data.tasks.base import GRIPPER_DIM, OBJECT_DIM, Task

Goals = TypeVar("Goals", np.ndarray, Tensor)


@dataclass(frozen=True)
class ObjectIndex:
    """One object: its kind, and where its features and its goal begin."""

    kind: int
    observation: int
    """First of its 15 features (see ``eisp_data.tasks.base.OBJECT_DIM``)."""
    goal: int
    """First of its 3 goal coordinates."""


@dataclass(frozen=True)
class Layout:
    """Sizes, and the objects where the environment has any.

    Without objects (any other ``GoalEnv``) the networks see plain vectors.
    """

    observation_dim: int
    goal_dim: int
    action_dim: int
    robot_dim: int = 0
    """Leading features of the observation that are the robot's own."""
    objects: tuple[ObjectIndex, ...] = ()
    latent_dim: int = 0
    """Of goal and observation, the last so many components are the latent of an image. It is no
    part of the distance between goals."""

    def apart(self, goals: Goals, others: Goals) -> Goals:
        """Return the way between (..., G) goals: what their distance is the norm of."""
        return goals[..., : self.places_dim] - others[..., : self.places_dim]

    @classmethod
    def of(cls, task: Task) -> Layout:
        """Return the layout of a task on the table as its states say it."""
        kinds = sorted({slot.kind for slot in task.objects})
        return cls(
            observation_dim=task.paper.observation_dim,
            goal_dim=task.paper.goal_dim,
            action_dim=task.paper.action_dim,
            robot_dim=GRIPPER_DIM,
            objects=tuple(
                ObjectIndex(kinds.index(slot.kind), slot.observation.start, slot.goal.start)
                for slot in task.objects
            ),
        )

    def seen(self, latent_dim: int) -> Layout:
        """Return this layout for images: without what follows the objects, and with a latent."""
        end = max(item.observation for item in self.objects) + OBJECT_DIM
        return replace(
            self,
            observation_dim=end + latent_dim,
            goal_dim=self.goal_dim + latent_dim,
            latent_dim=latent_dim,
        )

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Of observation, goal and action."""
        return self.observation_dim, self.goal_dim, self.action_dim

    @property
    def places_dim(self) -> int:
        """How many components of a goal, from the first on, count in its distance."""
        return self.goal_dim - self.latent_dim

    @property
    def kinds(self) -> int:
        """How many kinds of objects there are."""
        return len({item.kind for item in self.objects})
