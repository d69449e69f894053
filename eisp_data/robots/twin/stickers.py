"""Markers as pictures on the bodies of a scene."""

from __future__ import annotations

import mujoco
import numpy as np

from eisp_data.robots.charuco import board_picture, board_size, transform_sheet_to_tool
from eisp_data.robots.markers import RIM_M, MarkedObject, Marker, dictionary

_PIXELS_PER_M = 4000.0
_TINT = 0.35
"""Of the colour of what the sticker is on, in its rim."""
_ABOVE_M = 0.00003
"""Between the sticker and its body, or the two would flicker."""
_WHITE = np.array([0.93, 0.93, 0.93])
_INK = 0.06
"""Print is not quite black."""


def stick(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, item: MarkedObject, colour: np.ndarray
) -> None:
    """Put all markers of an object on its body; they touch nothing and weigh nothing.

    Args:
        spec: the scene.
        body: whose frame is the object's.
        item: the markers.
        colour: (3,) RGB, 0 to 1, of which the rim has a tint.
    """
    for marker in item.markers:
        _paste(
            spec,
            body,
            f"marker{marker.number}",
            marker_picture(marker, colour),
            (marker.size_m + 2 * RIM_M,) * 2,
            marker.transform_marker_to_object,
        )


def stick_board(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Put the ChArUco board into the hand, the frame of ``body``."""
    image = np.repeat(board_picture(_PIXELS_PER_M)[..., None], 3, axis=-1)
    image = (255 * _INK + (_WHITE[0] - _INK) * image).astype(np.uint8)
    _paste(spec, body, "board", image, board_size(), transform_sheet_to_tool())


def _paste(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    image: np.ndarray,
    size_m: tuple[float, float],
    pose: np.ndarray,
) -> None:
    """Put an (H, W, 3) picture of (width, height) on a body, its middle at (4, 4), x to its right,
    y to its top.
    """
    height, width = image.shape[:2]
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3
    )
    texture.data = image.tobytes()
    material = spec.add_material(name=name, specular=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(pose[:3, :3]).ravel())
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=_sheet(spec, size_m),
        material=name,
        pos=pose[:3, 3] + _ABOVE_M * pose[:3, 2],
        quat=quaternion,
        contype=0,
        conaffinity=0,
        mass=0.0,
    )


def marker_picture(marker: Marker, colour: np.ndarray) -> np.ndarray:
    """Return the marker with its rim, (H, H, 3) uint8, as one reads it."""
    import cv2

    code, rim = round(_PIXELS_PER_M * marker.size_m), round(_PIXELS_PER_M * RIM_M)
    bits = cv2.aruco.generateImageMarker(dictionary(), marker.number, code, borderBits=1) / 255.0
    image = np.empty((code + 2 * rim,) * 2 + (3,))
    image[:] = (1 - _TINT) * _WHITE + _TINT * colour
    image[rim:-rim, rim:-rim] = _INK + (_WHITE - _INK) * bits[..., None]
    return np.round(255.0 * image).astype(np.uint8)


def _sheet(spec: mujoco.MjSpec, size_m: tuple[float, float]) -> str:
    """Return the name of a flat mesh that shows a texture upright; it is made but once."""
    name = "sheet" + "x".join(str(round(1e6 * side)) for side in size_m)
    if any(mesh.name == name for mesh in spec.meshes):
        return name
    half = np.array([*size_m, 0.0]) / 2
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = corners.ravel()
    mesh.usernormal = np.tile([0.0, 0.0, 1.0], 4)
    mesh.usertexcoord = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=float).ravel()
    mesh.userface = faces.ravel()
    mesh.userfacenormal = faces.ravel()
    mesh.userfacetexcoord = faces.ravel()
    return name
