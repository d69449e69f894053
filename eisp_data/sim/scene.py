"""The MuJoCo scenes: a table, a floating parallel gripper, blocks and, for two tasks, a drawer.

World frame: the base of the robot at the height of the table top; x forward, y left, z up, metres.
The scene is a function of what stands on the table, so that a new task only names its objects.
"""

from __future__ import annotations

from functools import cache

import mujoco

TIMESTEP_S = 0.004
SUBSTEPS = 10
CONTROL_HZ = 25
"""1 / (TIMESTEP_S * SUBSTEPS), as in Gymnasium-Robotics' Fetch (20 substeps of 2 ms)."""

BLOCK_SIZE_M = 0.05
"""Edge of a block, as in Fetch."""

WORKSPACE_LOW_M = (0.18, -0.20, 0.020)
WORKSPACE_HIGH_M = (0.44, 0.20, 0.30)
"""Where the point between the fingertips may be: within reach of a UR3 (0.5 m) and of a TIAGo++."""

FINGER_TRAVEL_M = 0.04
"""Way of one finger from closed to open."""

_BLOCK_COLOURS = ("0.84 0.24 0.22 1", "0.20 0.55 0.84 1", "0.95 0.70 0.15 1", "0.36 0.69 0.35 1")

_SCENE = """
<mujoco model="eisp">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{timestep}" integrator="implicitfast" cone="elliptic" impratio="5"/>
  <size memory="4M"/>
  <visual>
    <headlight ambient="0.42 0.42 0.42" diffuse="0.28 0.28 0.28" specular="0 0 0"/>
    <global offwidth="640" offheight="480"/>
    <quality shadowsize="4096" offsamples="8"/>
    <map shadowclip="0.6"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.95 0.96 0.97" rgb2="0.72 0.77 0.82"
             width="64" height="384"/>
    <texture name="grain" type="2d" builtin="checker" rgb1="0.80 0.77 0.72" rgb2="0.78 0.75 0.70"
             width="256" height="256"/>
    <material name="table" texture="grain" texrepeat="6 7" specular="0.1"/>
  </asset>
  <default>
    <geom friction="0.7 0.01 0.0001" solref="0.008 1" condim="4"/>
    <default class="pad"><geom friction="1.5 0.02 0.0001" priority="1"/></default>
    <default class="visual"><geom contype="0" conaffinity="0" mass="0"/></default>
  </default>
  <worldbody>
    <light pos="0.05 -0.25 1.1" dir="0.22 0.18 -1" diffuse="0.52 0.52 0.50"/>
    <camera name="front" pos="-0.26 -0.36 0.55" fovy="36"
            xyaxes="0.5177 -0.8556 0 0.5027 0.3042 0.8092"/>
    <camera name="top" pos="0.33 0 0.85" xyaxes="0 -1 0 1 0 0" fovy="32"/>
    <camera name="shoulder" pos="-0.2 0 0.75" fovy="29" xyaxes="0 -1 0 0.8137 0 0.5812"/>
    <geom name="table" type="box" pos="0.35 0 -0.1" size="0.30 0.36 0.1" material="table"/>
    <body name="gripper" gravcomp="1">
      <joint name="gripper_x" type="slide" axis="1 0 0" armature="0.2"/>
      <joint name="gripper_y" type="slide" axis="0 1 0" armature="0.2"/>
      <joint name="gripper_z" type="slide" axis="0 0 1" armature="0.2"/>
      <geom name="palm" type="box" pos="0 0 0.065" size="0.018 0.055 0.014" mass="0.5"
            rgba="0.25 0.27 0.30 1"/>
      <geom class="visual" type="cylinder" pos="0 0 0.12" size="0.016 0.045"
            rgba="0.35 0.37 0.40 1"/>
      <body name="left_finger" gravcomp="1">
        <joint name="left_finger" type="slide" axis="0 1 0" range="0 {travel}" damping="5"/>
        <geom name="left_pad" class="pad" type="box" pos="0 0.006 0.0185" size="0.011 0.006 0.0325"
              mass="0.06" rgba="0.15 0.15 0.17 1"/>
      </body>
      <body name="right_finger" gravcomp="1">
        <joint name="right_finger" type="slide" axis="0 -1 0" range="0 {travel}" damping="5"/>
        <geom name="right_pad" class="pad" type="box" pos="0 -0.006 0.0185"
              size="0.011 0.006 0.0325" mass="0.06" rgba="0.15 0.15 0.17 1"/>
      </body>
    </body>
    {objects}
  </worldbody>
  <contact>
    {sliding}
    <exclude body1="left_finger" body2="right_finger"/>
    <exclude body1="gripper" body2="left_finger"/>
    <exclude body1="gripper" body2="right_finger"/>
  </contact>
  <equality>
    <joint joint1="left_finger" joint2="right_finger" solref="0.008 1"/>
  </equality>
  <actuator>
    <position joint="gripper_x" kp="6000" kv="160" forcerange="-60 60"/>
    <position joint="gripper_y" kp="6000" kv="160" forcerange="-60 60"/>
    <position joint="gripper_z" kp="6000" kv="160" forcerange="-60 60"/>
    <position joint="left_finger" kp="600" kv="45" forcerange="-12 12"/>
    <position joint="right_finger" kp="600" kv="45" forcerange="-12 12"/>
  </actuator>
</mujoco>
"""

_BLOCK = """
    <body name="block{index}" pos="0.3 {y} {half}">
      <freejoint name="block{index}"/>
      <geom name="block{index}" type="box" size="{half} {half} {half}" mass="0.1" rgba="{colour}"/>
    </body>"""

# MuJoCo's friction cone lifts what slides: at 1 m/s a block hopped 12 mm. A softer friction with
# the table takes that to 1 mm, and a sliding block still stops where Coulomb's law says.
_SLIDING = """
    <pair geom1="table" geom2="block{index}" friction="0.7 0.7 0.01 0.0001 0.0001" condim="4"
          solref="0.008 1" solreffriction="0.03 1"/>"""


def _block(index: int) -> str:
    half = BLOCK_SIZE_M / 2
    return _BLOCK.format(index=index, y=0.08 * index, half=half, colour=_BLOCK_COLOURS[index])


@cache
def table_scene(blocks: int, fixtures: str = "") -> str:
    """Return the MJCF of the scene with some blocks on the table.

    Args:
        blocks: how many blocks, at most four.
        fixtures: MJCF bodies that stand on the table besides, their joints before the blocks'.
            Each of their joints is a slide.
    """
    objects = fixtures + "".join(_block(index) for index in range(blocks))
    sliding = "".join(_SLIDING.format(index=index) for index in range(blocks))
    return _SCENE.format(
        timestep=TIMESTEP_S, travel=FINGER_TRAVEL_M, objects=objects, sliding=sliding
    )


@cache
def compile_scene(scene: str) -> mujoco.MjModel:
    """Compile MJCF; the same text is the same model."""
    return mujoco.MjModel.from_xml_string(scene)
