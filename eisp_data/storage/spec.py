"""DatasetSpec: the shapes, rates and names that every episode of one dataset shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from types import MappingProxyType
from typing import Any

from eisp_data.episode import Episode
from eisp_data.errors import DataError
from eisp_data.storage.schema import is_standard


def _empty() -> Mapping[str, Any]:
    return MappingProxyType({})


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """What the episodes of a dataset have in common; two datasets merge only if it is equal."""

    task: str
    """Registry name of the task, for example ``stack``."""
    instruction: str
    """The task as one English sentence; LeRobot's ``task`` of every frame."""
    fps: int = 25
    """Rows per second; timestamps are ``frame_index / fps`` seconds."""
    observation_dim: int
    """S, the width of ``Episode.observation``."""
    proprio_dim: int = 10
    """Leading components of the observation that are the robot's own (``observation.state``);
    the rest is ``observation.environment_state``."""
    goal_dim: int
    """G, the width of achieved and desired goals."""
    action_dim: int
    """A, the width of an action."""
    sim_state_dim: int = 0
    """P, the width of the simulator state; 0 for a real robot."""
    cameras: Mapping[str, tuple[int, int]] = field(default_factory=_empty)
    """Camera name to (height, width) in pixels; both even."""
    extras: Mapping[str, int] = field(default_factory=_empty)
    """Further float32 columns of each row, name to width: a log's source ages, for example."""
    robot_type: str = "simulated"
    """LeRobot's ``robot_type``."""

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "cameras", {c: (int(h), int(w)) for c, (h, w) in self.cameras.items()}
        )
        object.__setattr__(self, "extras", dict(self.extras))
        for name in ("fps", "observation_dim", "proprio_dim", "goal_dim", "action_dim"):
            if getattr(self, name) < 1:
                raise DataError(f"spec: {name} must be at least 1; got {getattr(self, name)}")
        if self.proprio_dim > self.observation_dim:
            raise DataError(
                f"spec: proprio_dim {self.proprio_dim} is more than observation_dim "
                f"{self.observation_dim}"
            )
        if self.sim_state_dim < 0:
            raise DataError(f"spec: sim_state_dim must not be negative; got {self.sim_state_dim}")
        if not self.instruction.strip():
            raise DataError("spec: the instruction must not be empty")
        for camera, size in self.cameras.items():
            if min(size) < 2 or size[0] % 2 or size[1] % 2:
                raise DataError(
                    f"spec: camera {camera!r} must have an even height and width for video; "
                    f"got {size}"
                )
        for name in (*self.cameras, *self.extras):
            if "/" in name or not name:
                raise DataError(f"spec: {name!r} cannot name a column: it must not hold a slash")
        for name in self.extras:
            if is_standard(name):  # it would silently take the place of the column itself
                raise DataError(
                    f"spec: {name!r} cannot name an extra column: every dataset has its own"
                )

    def check(self, episode: Episode) -> None:
        """Raise DataError, naming array and sizes, unless ``episode`` has this spec's shapes."""
        widths = {
            "observation": self.observation_dim,
            "achieved_goal": self.goal_dim,
            "action": self.action_dim,
            "sim_state": self.sim_state_dim,
        }
        for name, width in widths.items():
            got = getattr(episode, name).shape[1]
            if got != width:
                raise DataError(f"{name}: the dataset holds {width} components; got {got}")
        if set(episode.images) != set(self.cameras):
            raise DataError(
                f"cameras: the dataset holds {sorted(self.cameras)}; got {sorted(episode.images)}"
            )
        for camera, frames in episode.images.items():
            if frames.shape[1:3] != self.cameras[camera]:
                raise DataError(
                    f"image {camera!r}: the dataset holds {self.cameras[camera]} pixels; "
                    f"got {frames.shape[1:3]}"
                )

    def to_json(self) -> dict[str, Any]:
        """Return plain values that ``from_json`` takes back."""
        return {k: dict(v) if isinstance(v, Mapping) else v for k, v in asdict(self).items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> DatasetSpec:
        """Build a spec from what ``to_json`` gave, through JSON; unknown keys are an error."""
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise DataError(f"spec: unknown field(s) {unknown}; known: {sorted(known)}")
        try:
            return cls(
                **{**values, "cameras": {c: tuple(s) for c, s in values.get("cameras", {}).items()}}
            )
        except (TypeError, ValueError) as error:
            raise DataError(f"spec: {error}") from None
