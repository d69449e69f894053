"""The arms by name: which joints of which URDF, where the tool is, and what the hardware can do.

The tool's frame is the point between the fingertips. With the fingers pointing down its axes are
parallel to the base's: z up, and the fingers open along y.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from eisp_data.errors import ConfigError
from eisp_data.robots import cell
from eisp_data.robots.models import models_folder
from eisp_data.robots.robot import JointLimits

if TYPE_CHECKING:
    import pinocchio


@dataclass(frozen=True)
class Arm:
    """One arm of one robot; poses are in the frame of its URDF's root link."""

    name: str
    urdf: str
    """Below the folder of the models."""
    joint_names: tuple[str, ...]
    """J revolute joints, from the base to the tool."""
    tip_link: str
    """Where the gripper is screwed on."""
    transform_tool_to_tip: np.ndarray
    """(4, 4)."""
    home: tuple[float, ...]
    """(J,) rad: the posture that inverse kinematics leans towards."""
    acceleration: float
    """rad/s^2, of every joint; no URDF has one, so this is our choice."""
    gripper_m: tuple[float, float]
    gripper_speed_m_s: float
    task_in_base_m: tuple[float, float, float]
    """Where the task's frame lies, its axes parallel to the base's: a place where the arm reaches
    the whole workspace. A calibration replaces it."""
    tool_mass_kg: float
    effort: tuple[float, ...] = ()
    """(J,) N m where the URDF does not have the data sheet's."""
    pedestal_half_m: float = 0.0
    """Half the width of the square column under the base; 0 where it stands on none."""
    held: Mapping[str, float] = field(default_factory=dict)
    """Other joints of the URDF that are held away from zero, rad or m."""

    @property
    def transform_task_to_base(self) -> np.ndarray:
        """(4, 4)."""
        return cell.transform(np.eye(3), np.array(self.task_in_base_m))

    @property
    def urdf_path(self) -> Path:
        """The URDF; ConfigError without the ``robot`` extra."""
        return models_folder() / self.urdf


_TIAGO_TOOL_LENGTH_M = 0.155
"""From the wrist's force sensor to the fingertips of PAL's parallel gripper."""


def _tiago(side: str) -> Arm:
    # The tip's x leaves the hand, the tool's z enters it. Of the two ways round for a gripper whose
    # fingers are alike, this is the one with which the wrist is in the middle of its range.
    way = -1.0 if side == "left" else 1.0
    tool = cell.transform(
        np.array([[0.0, 0.0, -1.0], [0.0, way, 0.0], [way, 0.0, 0.0]]),
        np.array([_TIAGO_TOOL_LENGTH_M, 0.0, 0.0]),
    )
    # The other arm hangs where it cannot be met.
    other = "right" if side == "left" else "left"
    tucked = (-1.1, 1.4, 2.7, 1.7, -1.6, 1.3, 0.0)
    held = {f"arm_{other}_{i + 1}_joint": angle for i, angle in enumerate(tucked)}
    return Arm(
        name=f"tiago_{side}",
        urdf="tiago_description/robots/tiago_dual.urdf",
        joint_names=tuple(f"arm_{side}_{i}_joint" for i in range(1, 8)),
        tip_link=f"wrist_{side}_ft_tool_link",
        transform_tool_to_tip=tool,
        home=(1.01, -0.2, 2.22, 1.86, 0.02, -0.9, -0.35),
        acceleration=6.0,
        gripper_m=(0.0, 0.09),
        gripper_speed_m_s=0.1,
        task_in_base_m=(0.13, 0.22 if side == "left" else -0.22, 0.57),
        tool_mass_kg=0.8,
        held=held | {"torso_lift_joint": 0.35},
    )


ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm(
            name="ur3",
            urdf="ur_description/urdf/ur3_robot.urdf",
            joint_names=(
                "shoulder_pan_joint",
                "shoulder_lift_joint",
                "elbow_joint",
                "wrist_1_joint",
                "wrist_2_joint",
                "wrist_3_joint",
            ),
            tip_link="tool0",
            transform_tool_to_tip=cell.transform_tool_to_flange(),
            home=cell.HOME_RAD,
            acceleration=25.0,
            gripper_m=(0.0, 0.085),
            gripper_speed_m_s=0.15,
            task_in_base_m=tuple(cell.transform_task_to_base()[:3, 3]),
            tool_mass_kg=0.93,
            effort=(56.0, 56.0, 28.0, 12.0, 12.0, 12.0),
            pedestal_half_m=cell.PEDESTAL_HALF_M,
        ),
        _tiago("left"),
        _tiago("right"),
    )
}


def get_arm(name: str) -> Arm:
    """Return the arm of that name; ConfigError names the choices."""
    if name not in ARMS:
        raise ConfigError(f"unknown arm {name!r}; choose one of {', '.join(ARMS)}")
    return ARMS[name]


@cache
def arm_model(name: str) -> pinocchio.Model:
    """Return the arm's Pinocchio model, every other joint of the robot held; J = nq = nv.

    Raises:
        ConfigError: no such arm, or the ``robot`` extra is not installed.
    """
    import pinocchio as pin

    arm = get_arm(name)
    whole = pin.buildModelFromUrdf(str(arm.urdf_path))
    model = pin.buildReducedModel(whole, held_joints(whole, arm), held_posture(whole, arm))
    tip = model.frames[model.getFrameId(arm.tip_link)]
    middle = pin.SE3(arm.transform_tool_to_tip)
    middle.translation /= 2
    tool = pin.Inertia.FromSphere(arm.tool_mass_kg, 0.05)
    model.appendBodyToJoint(tip.parentJoint, tool, tip.placement * middle)
    if arm.effort:
        model.effortLimit = np.array(arm.effort)
    return model


def held_joints(whole: pinocchio.Model, arm: Arm) -> list[int]:
    """Return the ids of the joints that are not the arm's."""
    return [whole.getJointId(name) for name in whole.names[1:] if name not in arm.joint_names]


def held_posture(whole: pinocchio.Model, arm: Arm) -> np.ndarray:
    """Return the configuration (nq,) of the whole robot at which the other joints are held."""
    import pinocchio as pin

    posture = pin.neutral(whole)
    for joint, value in arm.held.items():
        posture[whole.joints[whole.getJointId(joint)].idx_q] = value
    return posture


def joint_limits(name: str) -> JointLimits:
    """Return what the arm's URDF and data sheet allow."""
    arm, model = get_arm(name), arm_model(name)
    return JointLimits(
        position_low=model.lowerPositionLimit.copy(),
        position_high=model.upperPositionLimit.copy(),
        velocity=model.velocityLimit.copy(),
        acceleration=np.full(model.nv, arm.acceleration),
        effort=model.effortLimit.copy(),
        gripper_m=arm.gripper_m,
        gripper_speed_m_s=arm.gripper_speed_m_s,
    )
