"""Whether an arm meets itself, the table or the pedestal that it stands on.

The links' own collision meshes, as convex hulls; what hangs on the flange is a box. The table is
everything below its top, and of the arm only what moves is held against table and pedestal.
"""

from __future__ import annotations

from functools import cache

import coal
import numpy as np
import pinocchio as pin

from eisp_data.robots.arms import Arm, arm_model, get_arm, held_joints, held_posture
from eisp_data.robots.models import models_folder

TABLE_MARGIN_M = 0.005
"""No link comes nearer to the table; the fingertips may, see the workspace in ``safety``."""

CLEARANCE_M = 0.003
"""Parts this near count as meeting: the search for the nearest points of two hulls is not exact
where they just touch."""

_GRIPPER_HALF_M = (0.03, 0.06)
"""Of the box around the gripper, across and along the way that the fingers open."""
_FINGERS_M = 0.04
"""The box ends above the fingertips: they touch things for a living."""
_PEDESTAL_M = 1.0
"""Height of the pedestal: down to below any table."""
_POSTURES = 300


class CollisionChecker:
    """Checks postures of one arm; the other joints of the robot are held."""

    def __init__(
        self,
        arm: str,
        transform_task_to_base: np.ndarray | None = None,
        clearance_m: float = CLEARANCE_M,
    ) -> None:
        """Load the meshes.

        Args:
            arm: a name in ``ARMS``.
            transform_task_to_base: (4, 4) of a frame that lies on the table top, z up; the arm's
                usual one if left out.
            clearance_m: parts nearer than this count as meeting.
        """
        spec, self._model = get_arm(arm), arm_model(arm)
        placed = spec.transform_task_to_base
        if transform_task_to_base is not None:
            placed = transform_task_to_base
        self._data = self._model.createData()
        geometry, moving = _geometry(arm)
        self._geometry = geometry.copy()
        up = placed[:3, 2]
        table = coal.Halfspace(up, up @ placed[:3, 3] + TABLE_MARGIN_M)
        _add_obstacle(self._geometry, "table", table, pin.SE3.Identity(), moving)
        half = spec.pedestal_half_m
        if half:
            below = pin.SE3(np.eye(3), np.array([0.0, 0.0, -_PEDESTAL_M / 2]))
            pedestal = coal.Box(2 * half, 2 * half, _PEDESTAL_M)
            _add_obstacle(self._geometry, "pedestal", pedestal, below, moving)
        self._geometry_data = self._geometry.createData()
        for request in self._geometry_data.collisionRequests:
            request.security_margin = clearance_m

    def is_clear(self, joint_position: np.ndarray) -> bool:
        """Whether the arm at (J,) rad meets nothing, itself included."""
        return not pin.computeCollisions(
            self._model, self._data, self._geometry, self._geometry_data, joint_position, True
        )

    def distance_m(self, joint_position: np.ndarray) -> float:
        """Return how far apart the nearest two parts are at (J,) rad; below 0 they overlap."""
        pin.computeDistances(
            self._model, self._data, self._geometry, self._geometry_data, joint_position
        )
        return min(result.min_distance for result in self._geometry_data.distanceResults)

    def meets(self, joint_position: np.ndarray) -> list[tuple[str, str]]:
        """Return the names of the links that meet at (J,) rad."""
        pin.computeCollisions(
            self._model, self._data, self._geometry, self._geometry_data, joint_position, False
        )
        names = [shape.name for shape in self._geometry.geometryObjects]
        results = zip(
            self._geometry.collisionPairs, self._geometry_data.collisionResults, strict=True
        )
        return [
            (names[pair.first], names[pair.second])
            for pair, result in results
            if result.isCollision()
        ]


def _add_obstacle(
    geometry: pin.GeometryModel,
    name: str,
    shape: coal.CollisionGeometry,
    place: pin.SE3,
    moving: list[int],
) -> None:
    """Add what stands in the base's frame, to be kept clear of by the shapes of those numbers."""
    number = geometry.addGeometryObject(pin.GeometryObject(name, 0, 0, place, shape))
    for other in moving:
        geometry.addCollisionPair(pin.CollisionPair(other, number))


@cache
def _geometry(arm: str) -> tuple[pin.GeometryModel, list[int]]:
    """Return the arm's shapes with the pairs that can meet, and those that can meet obstacles."""
    spec = get_arm(arm)
    geometry = _reduced_geometry(spec)
    _add_gripper(geometry, spec)
    model = arm_model(arm)
    shapes = geometry.geometryObjects
    moving = [i for i, shape in enumerate(shapes) if shape.parentJoint > 0]
    for i in moving:
        for j, other in enumerate(shapes):
            # Those of neighbouring joints touch by design.
            apart = abs(shapes[i].parentJoint - other.parentJoint)
            if apart > 1 and (j < i or other.parentJoint == 0):
                geometry.addCollisionPair(pin.CollisionPair(j, i))
    _drop_pairs_that_always_meet(model, geometry)
    # The first joint turns about the vertical: what hangs on it does not come down.
    return geometry, [i for i in moving if shapes[i].parentJoint > 1]


def _reduced_geometry(spec: Arm) -> pin.GeometryModel:
    """Return the meshes of the robot as convex hulls, without hands and wheels."""
    whole = pin.buildModelFromUrdf(str(spec.urdf_path))
    packages = [str(models_folder().parents[1])]
    geometry = pin.buildGeomFromUrdf(
        whole, str(spec.urdf_path), pin.GeometryType.COLLISION, package_dirs=packages
    )
    _, reduced = pin.buildReducedModel(
        whole, geometry, held_joints(whole, spec), held_posture(whole, spec)
    )
    for name in [shape.name for shape in reduced.geometryObjects]:
        if name.startswith(("hand_", "wheel_", "caster_", "ee_link")):
            reduced.removeGeometryObject(name)
    for shape in reduced.geometryObjects:
        if isinstance(shape.geometry, coal.BVHModelBase):
            shape.geometry.buildConvexHull(True, "Qt")
            shape.geometry = shape.geometry.convex
    return reduced


def _add_gripper(geometry: pin.GeometryModel, spec: Arm) -> None:
    model = arm_model(spec.name)
    tip = model.frames[model.getFrameId(spec.tip_link)]
    tool = pin.SE3(spec.transform_tool_to_tip)
    length = float(np.linalg.norm(tool.translation)) - _FINGERS_M
    # In the tool's frame the flange is above.
    middle = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, _FINGERS_M + length / 2]))
    box = coal.Box(2 * _GRIPPER_HALF_M[0], 2 * _GRIPPER_HALF_M[1], length)
    geometry.addGeometryObject(
        pin.GeometryObject("gripper", tip.parentJoint, 0, tip.placement * middle, box)
    )


def _drop_pairs_that_always_meet(model: pin.Model, geometry: pin.GeometryModel) -> None:
    """Leave out the pairs that meet in almost any posture: their hulls overlap by design."""
    data, geometry_data = model.createData(), geometry.createData()
    rng = np.random.default_rng(0)
    low = np.maximum(model.lowerPositionLimit, -np.pi)
    high = np.minimum(model.upperPositionLimit, np.pi)
    counts = np.zeros(len(geometry.collisionPairs))
    for posture in rng.uniform(low, high, (_POSTURES, model.nq)):
        pin.computeCollisions(model, data, geometry, geometry_data, posture, False)
        counts += [result.isCollision() for result in geometry_data.collisionResults]
    pairs = list(geometry.collisionPairs)
    for pair, count in zip(pairs, counts, strict=True):
        if count > 0.95 * _POSTURES:
            geometry.removeCollisionPair(pair)
