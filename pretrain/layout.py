"""How the observation and the goal of an environment are laid out, as far as learning needs it."""

from __future__ import annotations

from dataclasses import dataclass

from eisp_data.tasks.base import GRIPPER_DIM, Task


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

    Without objects (any other ``GoalEnv``, or images) the networks see plain vectors.
    """

    observation_dim: int
    goal_dim: int
    action_dim: int
    robot_dim: int = 0
    """Leading features of the observation that are the robot's own."""
    objects: tuple[ObjectIndex, ...] = ()

    @classmethod
    def of(cls, task: Task) -> Layout:
        """Return the layout of a task on the table."""
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

    @property
    def kinds(self) -> int:
        """How many kinds of objects there are."""
        return len({item.kind for item in self.objects})
