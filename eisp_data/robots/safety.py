"""What stands between a policy and a robot: no command leaves the limits, whatever is asked for.

Every command that is let through comes with a way to stop: from where it leads, braking all joints
together, the arm comes to rest without leaving any limit. A new command is let through only if it
has such a way too, else the arm takes the next step of the way it has. So by induction the limits
hold at every control period. Where the arm starts outside a limit it may only come nearer to it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from eisp_data.robots.arms import arm_model, get_arm
from eisp_data.robots.robot import JointCommand, JointLimits
from eisp_data.sim.scene import WORKSPACE_HIGH_M, WORKSPACE_LOW_M

if TYPE_CHECKING:
    from eisp_data.robots.collision import CollisionChecker

_TINY = 1e-9
_BLENDS = (1.0, 0.6, 0.3, 0.1)
"""How much of the way from braking to the wanted velocity is tried."""


@dataclass(frozen=True)
class SafetyConfig:
    """How much of what the hardware can do is used, and when the arm stops."""

    workspace_low_m: tuple[float, float, float] = (
        WORKSPACE_LOW_M[0] - 0.02,
        WORKSPACE_LOW_M[1] - 0.03,
        WORKSPACE_LOW_M[2] - 0.008,
    )
    """Of the point between the fingertips, in the task's frame: the tasks' own and a margin."""
    workspace_high_m: tuple[float, float, float] = (
        WORKSPACE_HIGH_M[0] + 0.02,
        WORKSPACE_HIGH_M[1] + 0.03,
        WORKSPACE_HIGH_M[2] + 0.05,
    )
    tool_speed_m_s: float = 1.0
    """Of that point; 1 m/s is what the policies were trained with."""
    velocity_share: float = 0.95
    """Of each joint's greatest velocity."""
    acceleration_share: float = 1.0
    effort_share: float = 0.9
    """Of each joint's greatest torque, as predicted and as measured."""
    jump_rad: float = 0.5
    """A command further than this from the last one is a fault, not a wish."""
    stale_s: float = 0.3
    """A reading older than this stops the robot."""
    following_rad: float = 0.35
    """An arm that is further than this from its last command is held by something."""
    check_collisions: bool = True
    """Of the arm with itself and with the table."""


class SafetyFilter:
    """Turns wanted joint targets into ones within all limits, one call a control period.

    Attributes:
        refusals: how often each kind of command was changed or refused.
    """

    def __init__(
        self,
        arm: str,
        limits: JointLimits,
        control_hz: float,
        config: SafetyConfig | None = None,
        transform_task_to_base: np.ndarray | None = None,
        collisions: CollisionChecker | None = None,
    ) -> None:
        """Prepare; call ``start`` first.

        Args:
            arm: a name in ``ARMS``.
            limits: what the hardware can do.
            control_hz: how often ``step`` is called.
            config: the default one if left out.
            transform_task_to_base: (4, 4), the arm's usual one if left out.
            collisions: what looks for them; left out, nothing does.
        """
        spec, self._model = get_arm(arm), arm_model(arm)
        self.config = config or SafetyConfig()
        self.limits, self.period_s = limits, 1.0 / control_hz
        self.refusals: Counter[str] = Counter()
        self._data = self._model.createData()
        tip = self._model.frames[self._model.getFrameId(spec.tip_link)]
        self._joint = tip.parentJoint
        self._tool = (tip.placement * pin.SE3(spec.transform_tool_to_tip)).translation
        placed = spec.transform_task_to_base
        if transform_task_to_base is not None:
            placed = transform_task_to_base
        self._rotation, self._origin = placed[:3, :3], placed[:3, 3]
        self._low = np.array(self.config.workspace_low_m)
        self._high = np.array(self.config.workspace_high_m)
        self._velocity = self.config.velocity_share * limits.velocity
        self._change = self.config.acceleration_share * limits.acceleration * self.period_s
        self._effort = self.config.effort_share * limits.effort
        self._collisions = collisions
        self.start(np.zeros(self._model.nv), limits.gripper_m[1])

    def start(self, joint_position: np.ndarray, gripper_opening_m: float) -> None:
        """Begin from an arm at rest at (J,) rad."""
        self._position = np.array(joint_position, float)
        self._moving = np.zeros_like(self._position)
        self._opening = float(np.clip(gripper_opening_m, *self.limits.gripper_m))
        self._way: list[np.ndarray] = []

    def rest(self) -> None:
        """Note that the arm has come to rest where it was sent last."""
        self._moving, self._way = np.zeros_like(self._position), []

    @property
    def position(self) -> np.ndarray:
        """The last targets (J,) rad that were let through."""
        return self._position

    def step(self, wanted: JointCommand) -> JointCommand:
        """Return the targets one control period on: the wanted ones, or as near as is allowed."""
        self._opening = self._gripper(wanted.gripper_opening_m)
        asked = np.asarray(wanted.joint_position, float)
        velocity = self._wanted_velocity(asked)
        if velocity is None:
            self._brake()
        elif not self._accept(velocity):
            self.refusals["limits"] += 1
            self._brake()
        return JointCommand(self._position.copy(), self._opening)

    def allows(self, joint_position: np.ndarray) -> bool:
        """Whether the arm may stand at (J,) rad: within limits and workspace, and clear."""
        path = joint_position[None]
        outside = self._outside(path, self._tool_in_task(path))[0]
        return outside <= 0.0 and (
            self._collisions is None or self._collisions.is_clear(joint_position)
        )

    @property
    def stopped(self) -> bool:
        """Whether the targets have come to rest."""
        return not self._moving.any()

    def _wanted_velocity(self, asked: np.ndarray) -> np.ndarray | None:
        """Return the velocity (J,) towards the wanted targets, None if they are a fault."""
        if asked.shape != self._position.shape or not np.isfinite(asked).all():
            self.refusals["not finite"] += 1
            return None
        way = asked - self._position
        if np.abs(way).max() > self.config.jump_rad:
            self.refusals["jump"] += 1
            return None
        velocity = way / self.period_s
        # All joints are slowed down together: the arm goes the same way, later.
        return velocity / max(1.0, (np.abs(velocity) / self._velocity).max())

    def _accept(self, wanted: np.ndarray) -> bool:
        """Take as much of the wanted velocity (J,) as has a way to stop; False if none has."""
        braking = self._moving * self._braking_share(self._moving)
        change = wanted - self._moving
        wanted = self._moving + change / max(1.0, (np.abs(change) / self._change).max())
        for blend in _BLENDS:
            velocity = braking + blend * (wanted - braking)
            way = self._way_to_stop(velocity)
            if way is not None:
                if blend < 1.0:
                    self.refusals["slowed"] += 1
                self._position, self._moving, self._way = way[0], velocity, way[1:]
                return True
        return False

    def _brake(self) -> None:
        """Take the next step of the way to stop."""
        if not self._way:
            self._moving = np.zeros_like(self._moving)
            return
        here, self._position = self._position, self._way.pop(0)
        self._moving = (self._position - here) / self.period_s

    def _braking_share(self, velocity: np.ndarray) -> float:
        """Return what is left of a velocity (J,) after one period of braking, as a factor."""
        fastest = (np.abs(velocity) / self._change).max()
        return 1.0 - 1.0 / fastest if fastest > 1.0 else 0.0

    def _way_to_stop(self, velocity: np.ndarray) -> list[np.ndarray] | None:
        """Return the targets from one step at that velocity to rest, None if any is not allowed."""
        velocities = self._braking_velocities(velocity)
        path = self._position + self.period_s * np.cumsum(velocities, axis=0)
        path = np.concatenate([self._position[None], path])
        places = self._tool_in_task(path)
        outside = self._outside(path, places)
        # Where it is outside now, it has to come nearer with each step.
        if (outside[1:] > np.maximum(outside[:-1], 0.0) + _TINY).any():
            return None
        longest = self.config.tool_speed_m_s * self.period_s
        if (np.square(np.diff(places, axis=0)).sum(axis=1) > longest**2 + _TINY).any():
            return None
        if not self._within_effort(path, velocities):
            return None
        way = list(path[1:])
        return way if self._stays_clear(way) else None

    def _braking_velocities(self, velocity: np.ndarray) -> np.ndarray:
        """Return (N, J): that velocity, then less and less of it, as fast as the joints may."""
        fastest = (np.abs(velocity) / self._change).max()
        steps = np.arange(max(1, int(np.ceil(fastest))))
        return np.outer(1.0 - steps / max(fastest, 1.0), velocity)

    def _outside(self, path: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return how far (N, J) rad and (N, 3) m are outside the limits, (N,); <= 0 within."""
        limits = self.limits
        joints = np.maximum(path - limits.position_high, limits.position_low - path)
        tool = np.maximum(places - self._high, self._low - places)
        return np.maximum(joints.max(axis=1), tool.max(axis=1))

    def _within_effort(self, path: np.ndarray, velocities: np.ndarray) -> bool:
        """Whether the torques of the whole way, to rest and at rest, are within the limits."""
        still = np.zeros_like(self._moving)
        # What standing here takes already is no reason not to leave.
        standing = pin.rnea(self._model, self._data, self._position, still, still)
        bound = np.maximum(self._effort, np.abs(standing)) + _TINY
        speeds = [*velocities, still, still]
        changes = np.diff([self._moving, *speeds], axis=0) / self.period_s
        torques = [
            pin.rnea(self._model, self._data, position, speed, change)
            for position, speed, change in zip([*path, path[-1]], speeds, changes, strict=True)
        ]
        return bool((np.abs(torques) <= bound).all())

    def _stays_clear(self, way: list[np.ndarray]) -> bool:
        """Whether the way is free of collisions, or leads out of the one that the arm is in."""
        checker = self._collisions
        if checker is None or all(map(checker.is_clear, way)):
            return True
        if checker.is_clear(self._position):
            return False
        apart = [checker.distance_m(posture) for posture in (self._position, *way)]
        return bool((np.diff(apart) > 0.0).all())

    def _tool_in_task(self, path: np.ndarray) -> np.ndarray:
        """Return (N, 3) m for (N, J) rad."""
        places = np.empty((len(path), 3))
        for place, joint_position in zip(places, path, strict=True):
            pin.forwardKinematics(self._model, self._data, joint_position)
            place[:] = self._data.oMi[self._joint].act(self._tool)
        return (places - self._origin) @ self._rotation

    def _gripper(self, wanted: float) -> float:
        """Return the opening in m after one period towards the wanted one."""
        if not np.isfinite(wanted):
            self.refusals["not finite"] += 1
            return self._opening
        within = float(np.clip(wanted, *self.limits.gripper_m))
        most = self.limits.gripper_speed_m_s * self.period_s
        return float(np.clip(within, self._opening - most, self._opening + most))
