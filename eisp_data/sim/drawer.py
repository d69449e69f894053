"""The drawer of OpenDrawer and Store: a cabinet, a sliding tray with a handle, and a kerb.

The drawer opens towards the robot (-x). A block that stands before it is pushed along until it is
jammed against the kerb, some 5 cm before the drawer is open: it has to be cleared away first.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from eisp_data.sim.scene import BLOCK_SIZE_M, table_scene

TRAVEL_M = 0.15
"""Way of the drawer from closed to open."""

HANDLE_CLOSED_M = (0.321, 0.0, 0.028)
"""Centre of the handle's bar, drawer closed; the bar runs along y and is as low as a block."""

HANDLE_GAP_M = 0.041
"""From the middle of the bar to the front panel: fingers 22 mm deep fit in behind the bar."""

BAR_HALF_M = 0.005

TRAY_CENTRE_M = (0.434, 0.0, 0.010 + BLOCK_SIZE_M / 2)
"""Centre of a block in the middle of the tray, drawer closed."""

TRAY_WALL_TOP_M = 0.038
"""Height of the tray's sides and back."""

PATH_HALF_WIDTH_M = 0.080
"""The drawer sweeps |y| up to here."""

KERB_M = 0.165
"""The kerb's face: no finger comes so near to the robot, and the open bar just does not touch."""

_WOOD, _FRONT, _HANDLE, _GLASS, _CLEAR = (
    "0.62 0.47 0.34 1", "0.93 0.90 0.85 1", "0.13 0.50 0.80 1", "0.75 0.85 0.90 0.25",
    "0.62 0.47 0.34 0.4",
)  # fmt: skip
_BUFFER = 'friction="0.2 0.01 0.0001" solref="0.014 1" priority="1"'
"""Of bar and kerb: hard and rough ones toss up the block that they catch between them."""
_Corner = tuple[float, float, float]


def _box(low: _Corner, high: _Corner, colour: str, name: str = "", attributes: str = "") -> str:
    centre, half = (np.add(low, high) / 2).round(6), (np.subtract(high, low) / 2).round(6)
    # Its own bit as contype: blocks and gripper meet these boxes, the boxes not one another.
    label = f'name="{name}"' if name else ""
    return (
        f'<geom {label} type="box" pos="{centre[0]} {centre[1]} {centre[2]}"'
        f' size="{half[0]} {half[1]} {half[2]}" rgba="{colour}" contype="2" {attributes}/>'
    )


def _drawer() -> str:
    bar_x, _, bar_z = HANDLE_CLOSED_M
    front = bar_x + HANDLE_GAP_M
    inside, back = front + 0.012, front + 0.132
    thick, side = BAR_HALF_M, 0.070
    boxes = [
        _box((front, -0.080, 0.003), (inside, 0.080, 0.050), _FRONT, "front"),
        _box((inside, -side, 0.002), (back, side, 0.010), _WOOD, "tray"),
        _box((inside, side, 0.002), (back, side + 0.006, TRAY_WALL_TOP_M), _WOOD),
        _box((inside, -side - 0.006, 0.002), (back, -side, TRAY_WALL_TOP_M), _WOOD),
        _box((back, -side - 0.006, 0.002), (back + 0.006, side + 0.006, TRAY_WALL_TOP_M), _WOOD),
        _box(
            (bar_x - thick, -0.045, bar_z - 0.016),
            (bar_x + thick, 0.045, bar_z + 0.016),
            _HANDLE,
            "handle",
        ),
        _box((bar_x + thick, 0.037, bar_z - 0.005), (front, 0.045, bar_z + 0.005), _HANDLE),
        _box((bar_x + thick, -0.045, bar_z - 0.005), (front, -0.037, bar_z + 0.005), _HANDLE),
    ]
    return "\n".join(boxes)


def _cabinet() -> str:
    front, back = HANDLE_CLOSED_M[0] + HANDLE_GAP_M + 0.014, 0.52
    boxes = [
        _box((front, 0.079, 0.0), (back, 0.089, 0.072), _WOOD),
        _box((front, -0.089, 0.0), (back, -0.079, 0.072), _WOOD),
        _box((back, -0.089, 0.0), (back + 0.01, 0.089, 0.072), _WOOD),
        _box((front, -0.089, 0.072), (back + 0.01, 0.089, 0.082), _GLASS, "cabinet"),
        _box((KERB_M - 0.015, -0.10, 0.0), (KERB_M, 0.10, 0.060), _CLEAR, "kerb", _BUFFER),
    ]
    return "\n".join(boxes)


@cache
def drawer_scene() -> str:
    """Return the table with the drawer and one block; the drawer's slide is 0 when closed."""
    fixtures = f"""
    {_cabinet()}
    <body name="drawer" gravcomp="1">
      <inertial pos="{TRAY_CENTRE_M[0]} 0 0.02" mass="0.6" diaginertia="0.002 0.002 0.003"/>
      <joint name="drawer" type="slide" axis="-1 0 0" range="0 {TRAVEL_M}" damping="6"
             frictionloss="1.5" solreflimit="0.008 1"/>
      {_drawer()}
    </body>"""
    return table_scene(1, fixtures)
