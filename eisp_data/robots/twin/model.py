"""The twin's cell: the objects of a task on their table, before a UR3 with a gripper.

The world's frame is the task's. Table, blocks, drawer and the gripper's fingers are those of the
task's own scene; only what moves the gripper is another: an arm instead of three slides.
"""

from __future__ import annotations

import mujoco
import numpy as np

from eisp_data.robots import cell
from eisp_data.robots.markers import marked_objects
from eisp_data.robots.twin.arm import arm_spec
from eisp_data.robots.twin.stickers import stick, stick_board
from eisp_data.tasks.base import Task

HAND = "hand/"
"""What the names of the gripper's parts begin with."""
FINGERS = (f"{HAND}left_finger", f"{HAND}right_finger")
TOOL = "tool"
"""Site at the point between the fingertips."""
TIMESTEP_S = 0.002

_SLIDES = ("gripper_x", "gripper_y", "gripper_z")
_FLOOR_M = -0.2
_FLOOR_HALF_M = [4.0, 4.0, 0.01]
_TABLE, _FLOOR = [0.79, 0.76, 0.71, 1.0], [0.72, 0.78, 0.83, 1.0]
_DARK = np.array([0.25, 0.27, 0.30])
_UNSEEN = 4
"""A group of sites that no picture shows."""
_PALE = np.array([0.80, 0.77, 0.72])


def cell_spec(task: Task, board: bool = False) -> mujoco.MjSpec:
    """Return the cell of a task, to be changed or compiled; the gripper may hold the board."""
    spec = mujoco.MjSpec.from_string(task.scene)
    spec.delete(spec.body("gripper"))
    _mount_arm(spec, task)
    _mark(spec, task, board)
    spec.option.timestep = TIMESTEP_S
    # The light of the scene leaves the faces that the camera sees in the dark.
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.55] * 3
    spec.lights[0].diffuse = [0.2] * 3
    # Each would take three times as long as all the rest of a picture.
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    _simplify(spec)
    return spec


def _simplify(spec: mujoco.MjSpec) -> None:
    """Paint sky and table plain: their textures took half of the time of a picture.

    The table's two shades differ by as much as the noise of the camera.
    """
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    table = spec.geom("table")
    table.material, table.rgba = "", _TABLE
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.0, 0.0, _FLOOR_M - _FLOOR_HALF_M[2]],
        size=_FLOOR_HALF_M,
        rgba=_FLOOR,
        contype=0,
        conaffinity=0,
    )


def _mount_arm(spec: mujoco.MjSpec, task: Task) -> None:
    x, y, z = cell.BASE_IN_TASK_M
    half = (z - _FLOOR_M) / 2
    spec.worldbody.add_geom(
        name="pedestal",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[x, y, _FLOOR_M + half],
        size=[cell.PEDESTAL_HALF_M, cell.PEDESTAL_HALF_M, half],
        rgba=[0.45, 0.47, 0.5, 1.0],
    )
    arm = arm_spec()
    spec.worldbody.add_frame(pos=[x, y, z]).attach_body(arm.body("base_link"), "", "")
    hand = mujoco.MjSpec.from_string(task.scene)
    for slide in _SLIDES:
        hand.delete(hand.joint(slide))
    for servo in hand.actuators:
        servo.name = servo.target
    quaternion = np.empty(4)
    mount = cell.transform_tool_to_flange()
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(mount[:3, :3]).ravel())
    flange = spec.body("tool0")
    gripper = flange.add_frame(pos=mount[:3, 3], quat=quaternion).attach_body(
        hand.body("gripper"), HAND, ""
    )
    gripper.add_site(name=TOOL, group=_UNSEEN)


def _mark(spec: mujoco.MjSpec, task: Task, board: bool) -> None:
    """Put the markers on all that carries some."""
    for item in marked_objects(task).values():
        if item.name == "gripper" and board:
            stick_board(spec, spec.body(f"{HAND}gripper"))
        elif item.name == "gripper":
            stick(spec, spec.body(f"{HAND}gripper"), item, _DARK)
        elif item.name == "table":
            stick(spec, spec.worldbody, item, _PALE)
        else:
            body = spec.body(item.name)
            stick(spec, body, item, np.array(body.geoms[0].rgba[:3], dtype=float))
