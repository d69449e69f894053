"""Forward and inverse kinematics of an arm.

The inverse is a Levenberg-Marquardt descent (Sugihara 2011: damping that follows the error, so that
it is quick near a solution and does not jump near a singularity) within the joint limits. It starts
at a given posture, then at the nearest of a table of postures whose poses are known, then at the
next nearest ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pinocchio as pin

from eisp_data.errors import RobotError
from eisp_data.robots.arms import arm_model, get_arm

TOLERANCE = 1e-5
"""A solution is this near, in metres and radians taken together."""

_TABLE_SIZE = 20_000
_RESTARTS = 200
_STEPS = 14
_LONGEST_STEP_RAD = 0.6
_DAMPING = 1e-3
_LEAST_DAMPING = 1e-7
_POSTURE_GAIN = 0.3
_RADIUS_M = 0.2
"""How far a radian is in the distance between two poses."""

Accept = Callable[[np.ndarray], bool]


class Kinematics:
    """The kinematics of one arm; transforms are (4, 4), tool to base, metres.

    Attributes:
        low, high: (J,) rad, the joint limits.
        home: (J,) rad.
    """

    def __init__(self, arm: str) -> None:
        """Load the model; ConfigError if there is no such arm."""
        spec, model = get_arm(arm), arm_model(arm)
        self.arm = arm
        self.low, self.high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
        self.home = np.array(spec.home)
        self._model, self._data = model, model.createData()
        tip = model.frames[model.getFrameId(spec.tip_link)]
        self._joint = tip.parentJoint
        self._tool_to_joint = tip.placement * pin.SE3(spec.transform_tool_to_tip)
        self._joint_to_tool = self._tool_to_joint.inverse()
        # A joint that can turn all the way round has each posture more than once.
        self._turns = self.high - self.low >= 2 * np.pi - 1e-6
        self._table = np.empty((0, model.nq))
        self._features = np.empty((0, 12), np.float32)

    def forward(self, joint_position: np.ndarray) -> np.ndarray:
        """Return where the tool is at (J,) rad."""
        return (self._place(joint_position) * self._tool_to_joint).homogeneous

    def jacobian(self, joint_position: np.ndarray) -> np.ndarray:
        """Return (6, J): velocity of the tool's point, then angular velocity, axes of the base."""
        pin.computeJointJacobians(self._model, self._data, joint_position)
        local = pin.getJointJacobian(self._model, self._data, self._joint, pin.ReferenceFrame.LOCAL)
        rotation = self._data.oMi[self._joint].rotation @ self._tool_to_joint.rotation
        at_tool = self._joint_to_tool.toActionMatrix() @ local
        return np.concatenate([rotation @ at_tool[:3], rotation @ at_tool[3:]])

    def random_postures(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw (count, J) rad uniformly within the limits; of whole turns, one."""
        low = np.where(self._turns, np.maximum(self.low, -np.pi), self.low)
        high = np.where(self._turns, np.minimum(self.high, np.pi), self.high)
        return rng.uniform(low, high, (count, len(low)))

    def inverse(
        self,
        transform_tool_to_base: np.ndarray,
        near: np.ndarray | None = None,
        accept: Accept | None = None,
    ) -> np.ndarray:
        """Return a posture (J,) rad within the limits that puts the tool there.

        Args:
            transform_tool_to_base: (4, 4).
            near: (J,) rad, a posture to start from and stay close to.
            accept: which solutions will do, for instance those without a collision.

        Raises:
            RobotError: none was found.
        """
        for found in self._solutions(transform_tool_to_base, near):
            if accept is None or accept(found):
                return found
        x, y, z = transform_tool_to_base[:3, 3]
        raise RobotError(
            f"unreachable goal: no posture of {self.arm} puts the tool at"
            f" ({x:.3f}, {y:.3f}, {z:.3f}) m in its base"
            + (", or all collide" if accept is not None else "")
        )

    def track(self, transform_tool_to_base: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Return the posture (J,) rad on the way from ``start`` that is next to the wanted pose.

        For a stream of close poses: no restarts, so no jump to another branch. Where the pose is
        out of reach the arm goes as near as it can.
        """
        return self._descend(self._joint_target(transform_tool_to_base), start)[0]

    def _solutions(
        self, transform_tool_to_base: np.ndarray, near: np.ndarray | None
    ) -> Iterator[np.ndarray]:
        target = self._joint_target(transform_tool_to_base)
        for start in self._starts(transform_tool_to_base, near):
            found, solved = self._descend(target, start)
            if solved:
                yield self._unwind(found, near)

    def _starts(
        self, transform_tool_to_base: np.ndarray, near: np.ndarray | None
    ) -> Iterator[np.ndarray]:
        if near is not None:
            yield np.clip(near, self.low, self.high)
        if not len(self._table):
            self._fill_table()
        # |a - b|^2 without the part that is the same for all.
        feature = _feature(transform_tool_to_base)
        distance = self._norms - 2.0 * (self._features @ feature)
        if near is None:
            yield self._table[distance.argmin()]
            nearest = np.argpartition(distance, _RESTARTS)[:_RESTARTS]
            yield from self._table[nearest[np.argsort(distance[nearest])]][1:]
            return
        # Of the postures with about the right pose, first those next to where the arm is.
        nearest = np.argpartition(distance, _RESTARTS)[:_RESTARTS]
        turn = np.abs(self._table[nearest] - near).max(axis=1)
        yield from self._table[nearest[np.argsort(turn)]]

    def _descend(self, target: pin.SE3, start: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the posture (J,) nearest to the joint's target pose, and whether it is there."""
        position, before = start, np.inf
        for step in range(_STEPS):
            jacobian = pin.computeJointJacobian(self._model, self._data, position, self._joint)
            error = pin.log6(self._place(position).actInv(target)).vector
            square = error.dot(error)
            if square < TOLERANCE**2:
                return position, True
            if step > 7 and square > 0.5 * before:
                break
            position, before = self._step(position, jacobian, error, square), square
        return position, False

    def _step(
        self, position: np.ndarray, jacobian: np.ndarray, error: np.ndarray, square: float
    ) -> np.ndarray:
        """Return the next posture (J,); joints that reach a limit stay there, the others go on."""
        lean = (_POSTURE_GAIN * min(1.0, square**0.5)) * (self.home - position)
        gradient = jacobian.T @ (error - jacobian @ lean)
        matrix = jacobian.T @ jacobian
        matrix.flat[:: len(position) + 1] += _DAMPING * square + _LEAST_DAMPING
        move = _shortened(np.linalg.solve(matrix, gradient) + lean)
        wanted = position + move
        reached = np.minimum(np.maximum(wanted, self.low), self.high)
        free = reached == wanted
        if free.all() or not free.any():
            return reached
        rest = error - jacobian[:, ~free] @ (reached - position)[~free]
        move = np.linalg.solve(matrix[np.ix_(free, free)], jacobian[:, free].T @ rest)
        reached[free] = position[free] + _shortened(move)
        return np.minimum(np.maximum(reached, self.low), self.high)

    def _unwind(self, position: np.ndarray, near: np.ndarray | None) -> np.ndarray:
        """Return the same posture with the least turns, from ``near`` or from zero."""
        origin = np.zeros_like(position) if near is None else near
        turned = origin + np.remainder(position - origin + np.pi, 2 * np.pi) - np.pi
        allowed = self._turns & (turned >= self.low) & (turned <= self.high)
        return np.where(allowed, turned, position)

    def _place(self, position: np.ndarray) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, position)
        return self._data.oMi[self._joint]

    def _joint_target(self, transform_tool_to_base: np.ndarray) -> pin.SE3:
        return pin.SE3(transform_tool_to_base) * self._joint_to_tool

    def _fill_table(self) -> None:
        self._table = self.random_postures(np.random.default_rng(0), _TABLE_SIZE)
        self._features = np.stack([_feature(self.forward(row)) for row in self._table])
        self._norms = (self._features**2).sum(axis=1)


@cache
def kinematics(arm: str) -> Kinematics:
    """Return the arm's kinematics, made once; not to be shared between threads."""
    return Kinematics(arm)


def _shortened(move: np.ndarray) -> np.ndarray:
    longest = np.abs(move).max()
    return move * (_LONGEST_STEP_RAD / longest) if longest > _LONGEST_STEP_RAD else move


def _feature(transform: np.ndarray) -> np.ndarray:
    """Return (12,) float32 whose Euclidean distance is that between poses, in metres."""
    # The Frobenius distance of two rotations is sqrt(2) times their angle, for small ones.
    scale = _RADIUS_M / 2**0.5
    return np.concatenate([transform[:3, 3], scale * transform[:3, :3].ravel()]).astype(np.float32)
