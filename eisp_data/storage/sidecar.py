"""The sidecar: what LeRobot v3 has no place for, kept where its tools cannot lose it.

LeRobot's delete, split and merge write a new dataset, renumber episodes and copy nothing but
the columns of the feature table: extra files, extra columns of ``meta/episodes`` and unknown
keys of ``info.json`` all vanish. So the sidecar of an episode is a JSON string in a column of its
own, in the first row of the episode; it moves with the rows. It holds the last observation with
its achieved goal, simulator state and images, whether the first observation was a success, the
seed, the info mapping, and the dataset's spec and recipe.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from eisp_data.episode import Episode, Scalar
from eisp_data.errors import DataError
from eisp_data.storage.files import one_line
from eisp_data.storage.spec import DatasetSpec
from eisp_data.storage.video import decode_jpeg, encode_jpeg

FORMAT = 1
_SHARED = '"spec": {'
"""How ``dataset_part`` begins; what ``encode`` puts before it cannot hold this after a comma."""


@dataclass(frozen=True)
class Sidecar:
    """One episode's sidecar, decoded."""

    steps: int
    """T: a file that ends before has lost part of the episode."""
    seed: int
    info: dict[str, Scalar]
    first_success: bool
    observation: np.ndarray
    """(S,) float32: the last observation."""
    achieved_goal: np.ndarray
    """(G,) float32: what it achieved."""
    sim_state: np.ndarray
    """(P,) float64: the simulator's state there."""
    images: dict[str, bytes]
    """Camera name to the last image, JPEG."""
    spec: DatasetSpec
    recipe: dict[str, Any]

    def image(self, camera: str) -> np.ndarray:
        """Return the last image of a camera, (H, W, 3) uint8; DataError if it is another size."""
        image, (height, width) = decode_jpeg(self.images[camera]), self.spec.cameras[camera]
        if image.shape != (height, width, 3):
            raise DataError(
                f"the last image of camera {camera!r} is {image.shape[0]} x {image.shape[1]} "
                f"pixels, not {height} x {width}"
            )
        return image


def plain_info(info: Mapping[str, Any]) -> dict[str, Scalar]:
    """Return an episode's info with NumPy scalars made plain; DataError for anything else."""
    plain: dict[str, Scalar] = {}
    for name, value in info.items():
        value = value.item() if isinstance(value, np.generic) else value
        if not isinstance(name, str) or not isinstance(value, str | int | float | bool):
            raise DataError(
                f"info: {name!r} must be a string, a number or a truth value; got {value!r}"
            )
        plain[name] = value
    return plain


def dataset_part(spec: DatasetSpec, recipe: Mapping[str, Any]) -> str:
    """Return the JSON fragment that every episode of a dataset shares."""
    shared = {"spec": spec.to_json(), "recipe": dict(recipe)}
    return json.dumps(shared, ensure_ascii=False)[1:-1]


def encode(episode: Episode, shared: str) -> str:
    """Return the sidecar string of ``episode``; ``shared`` comes from ``dataset_part``."""
    final = {
        "observation": _to_text(episode.observation[-1].tobytes()),
        "achieved_goal": _to_text(episode.achieved_goal[-1].tobytes()),
        "sim_state": _to_text(episode.sim_state[-1].tobytes()),
        "images": {c: _to_text(encode_jpeg(f[-1])) for c, f in episode.images.items()},
    }
    own = {
        "eisp": FORMAT,
        "steps": len(episode),
        "seed": int(episode.seed),
        "info": plain_info(episode.info),
        "first_success": bool(episode.success[0]),
        "final": final,
    }
    return json.dumps(own, ensure_ascii=False)[:-1] + ", " + shared + "}"


def decode(text: str, where: str) -> Sidecar:
    """Return the sidecar of a string; DataError, beginning with ``where``, if it is broken."""
    try:
        value = _parse(text)
        if value["eisp"] != FORMAT:
            raise DataError(
                f"{where}: sidecar format {value['eisp']!r}; this version reads {FORMAT}"
            )
        spec = DatasetSpec.from_json(value["spec"])
        final = value["final"]
        sidecar = Sidecar(
            steps=int(value["steps"]),
            seed=int(value["seed"]),
            info=plain_info(value["info"]),
            first_success=bool(value["first_success"]),
            observation=_to_array(final["observation"], np.float32, spec.observation_dim),
            achieved_goal=_to_array(final["achieved_goal"], np.float32, spec.goal_dim),
            sim_state=_to_array(final["sim_state"], np.float64, spec.sim_state_dim),
            images={c: base64.b64decode(t, validate=True) for c, t in final["images"].items()},
            spec=spec,
            recipe=dict(value["recipe"]),
        )
    except DataError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, binascii.Error, RecursionError) as bad:
        reason = f"{type(bad).__name__}: {one_line(bad)}"
        raise DataError(f"{where}: the sidecar cannot be read ({reason})") from None
    if set(sidecar.images) != set(spec.cameras):
        raise DataError(
            f"{where}: the sidecar has images of {sorted(sidecar.images)}; "
            f"the dataset's cameras are {sorted(spec.cameras)}"
        )
    return sidecar


def _parse(text: str) -> dict[str, Any]:
    """Return the JSON of a sidecar, with one object for the equal dataset parts of several."""
    own, comma, shared = text.partition(f", {_SHARED}")
    if not comma:
        value: dict[str, Any] = json.loads(text)
        return value
    return {**json.loads(own + "}"), **_parse_shared(f"{{{_SHARED}{shared}")}


@lru_cache(maxsize=4)
def _parse_shared(text: str) -> dict[str, Any]:
    """Return the JSON of a dataset part, which names every file that a dataset was made of."""
    value: dict[str, Any] = json.loads(text)
    return value


def _to_text(raw: bytes) -> str:
    return base64.b64encode(raw).decode("ascii")


def _to_array(text: str, dtype: type, width: int) -> np.ndarray:
    array: np.ndarray = np.frombuffer(base64.b64decode(text, validate=True), dtype=dtype)
    if array.shape != (width,):
        raise ValueError(f"expected {width} values, got {array.size}")
    if not np.isfinite(array).all():
        raise ValueError("not finite")
    return array
