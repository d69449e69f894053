"""The UR3 of the twin: URDF and meshes of ``example-robot-data``, with joint servos."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from functools import cache

import mujoco
import numpy as np

from eisp_data.robots.arms import ARMS
from eisp_data.robots.models import models_folder

JOINTS = ARMS["ur3"].joint_names
_EFFORT_NM = np.array(ARMS["ur3"].effort)
"""The UR3's greatest joint torques (its data sheet; the URDF has those of a UR5)."""

_STIFFNESS = np.array([6000.0, 6000.0, 4000.0, 1000.0, 1000.0, 700.0])
_DAMPING = np.array([180.0, 180.0, 90.0, 20.0, 20.0, 12.0])
_ARMATURE = np.array([0.6, 0.6, 0.3, 0.08, 0.08, 0.05])
"""Inertia of the rotors behind their 100:1 gears, kg m^2: it outweighs the links' own."""
_FRICTION_NM = np.array([0.6, 0.6, 0.4, 0.15, 0.15, 0.15])

SERVO_LEAD_S = _DAMPING / _STIFFNESS
"""How far a moving joint lags behind its target; (6,)."""

_COLOURS = {"shoulder": "blue", "upper": "grey", "forearm": "grey"}
_RGBA = {"grey": (0.72, 0.74, 0.76, 1.0), "blue": (0.36, 0.50, 0.62, 1.0)}


def arm_spec() -> mujoco.MjSpec:
    """Return the arm with its base at the origin, joints at ``JOINTS``, and one servo for each.

    Raises:
        ConfigError: the ``robot`` extra is not installed.
    """
    spec = mujoco.MjSpec.from_string(_urdf())
    spec.compiler.degree = False
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
        for geom in body.geoms:
            _dress(geom, body.name)
    for index, name in enumerate(JOINTS):
        joint = spec.joint(name)
        joint.armature = float(_ARMATURE[index])
        joint.frictionloss = float(_FRICTION_NM[index])
        servo = spec.add_actuator(name=name, target=name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=float(_STIFFNESS[index]), kv=float(_DAMPING[index]))
        servo.forcelimited = True
        servo.forcerange = _EFFORT_NM[index] * np.array([-1.0, 1.0])
    # These touch in every pose; only of a parent and its child MuJoCo knows that by itself.
    spec.add_exclude(bodyname1="base_link", bodyname2="shoulder_link")
    spec.add_exclude(bodyname1="wrist_1_link", bodyname2="wrist_3_link")
    return spec


def _dress(geom: mujoco.MjsGeom, body: str) -> None:
    part = next((colour for start, colour in _COLOURS.items() if body.startswith(start)), "blue")
    geom.rgba = np.array(_RGBA[part], np.float32)


@cache
def _urdf() -> str:
    """Return the URDF with the paths of the meshes that collide, and without those for the eye.

    The two have the same shape. MuJoCo reads STL but not the COLLADA of the latter.
    """
    folder = models_folder()
    root = ElementTree.parse(folder / "ur_description/urdf/ur3_robot.urdf").getroot()
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in root.iter("mesh"):
        path = mesh.attrib["filename"].removeprefix("package://example-robot-data/robots/")
        mesh.set("filename", str(folder / path))
    options = {"strippath": "false", "fusestatic": "false", "balanceinertia": "true"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    return ElementTree.tostring(root, encoding="unicode")
