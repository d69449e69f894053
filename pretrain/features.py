"""What the networks see of (observation, goal).

``PlainFeatures`` standardises and concatenates, as the paper does. ``ObjectFeatures`` uses that
the goal is a set of places for objects: everything relative, the object to be moved first, and
interchangeable objects in an order of their own, so that one skill serves them all.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pretrain.layout import Layout

_LENGTH = 10.0
"""Ten per metre: the table's decimetres become units."""
_SPEED = 2.0
_SPIN = 0.2
_ROBOT_CENTRE = [0.31, 0.0, 0.1, *[0.0] * 7]
_ROBOT_SCALE = [*[_LENGTH] * 3, *[4 * _LENGTH] * 2, *[_SPEED] * 3, *[2 * _SPEED] * 2]
"""Of place, fingers, velocity and the fingers' velocities."""
_OBJECT_CENTRE = [0.31, 0.0, 0.05, *[0.0] * 12]
_OBJECT_SCALE = [*[_LENGTH] * 6, *[1.0] * 3, *[_SPEED] * 3, *[_SPIN] * 3]
"""Of place, place from the gripper, Euler angles, velocity and spin."""


class PlainFeatures(nn.Module):
    """Standardised observation and goal, side by side."""

    observation_mean: Tensor
    observation_std: Tensor
    goal_mean: Tensor
    goal_std: Tensor

    def __init__(self, layout: Layout, moments: dict[str, Tensor]) -> None:
        super().__init__()
        for name in ("observation_mean", "observation_std", "goal_mean", "goal_std"):
            self.register_buffer(name, moments[name].clone())
        self.size = layout.observation_dim + layout.goal_dim

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return (B, size) features of (B, S) observations and (B, G) goals."""
        state = (observation - self.observation_mean) / self.observation_std
        target = (goal - self.goal_mean) / self.goal_std
        return torch.cat([state, target], -1).clamp(-10, 10)


class ObjectFeatures(nn.Module):
    """The object that has the longest way to its goal first, the others by their distance to it.

    Objects change places only with others of their kind. The latent of an image comes last,
    standardised; of a goal only the places count, for its reward depends on nothing else.
    """

    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, layout: Layout, moments: dict[str, Tensor]) -> None:
        super().__init__()
        if layout.latent_dim:
            for name in ("mean", "std"):
                latent = moments[f"observation_{name}"][-layout.latent_dim :]
                self.register_buffer(f"latent_{name}", latent.clone())
        self._layout = layout
        self._interchangeable = layout.kinds == 1 and len(layout.objects) > 1
        count = len(layout.objects)
        self.size = layout.robot_dim + _TOKEN_DIM * count + 6 * (count - 1) + layout.latent_dim
        if not self._interchangeable:
            self.size += count

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return (B, size) features of (B, S) observations and (B, G) goals."""
        robot = scaled_robot(observation[:, : self._layout.robot_dim])
        tokens = object_tokens(self._layout, observation, goal)
        way = tokens[..., _WAY].norm(dim=-1)
        focus = way.argmax(1)
        if self._interchangeable:
            position = tokens[..., _POSITION]
            anchor = position.gather(1, focus[:, None, None].expand(-1, 1, 3))
            apart = (position - anchor).norm(dim=-1)
            apart.scatter_(1, focus[:, None], -1.0)
            order = apart.argsort(1)
            tokens = tokens.gather(1, order[..., None].expand(-1, -1, tokens.shape[-1]))
            extra = []
        else:
            extra = [torch.zeros_like(way).scatter_(1, focus[:, None], 1.0)]
        if self._layout.latent_dim:
            latent = observation[:, -self._layout.latent_dim :]
            extra.append(((latent - self.latent_mean) / self.latent_std).clamp(-10, 10))
        position = tokens[..., _POSITION]
        target = position[:, :1] + tokens[:, :1, _WAY]
        others = [position[:, 1:] - position[:, :1], position[:, 1:] - target]
        return torch.cat([robot, tokens.flatten(1), *[x.flatten(1) for x in others], *extra], -1)


_TOKEN_DIM = 20
_POSITION = slice(0, 3)
_WAY = slice(6, 9)


def scaled_robot(robot: Tensor) -> Tensor:
    """Return the (B, 10) gripper features in the networks' units."""
    return (robot - robot.new_tensor(_ROBOT_CENTRE)) * robot.new_tensor(_ROBOT_SCALE)


def object_tokens(layout: Layout, observation: Tensor, goal: Tensor) -> Tensor:
    """Return (B, objects, 20): place, place from the gripper, way to the goal, tilt, turn, speeds.

    A cube looks the same after a quarter turn, so the yaw enters as the sine and cosine of four
    times itself; the last feature tells how long the way is.
    """
    objects = layout.objects
    seen = torch.stack([observation[:, i.observation : i.observation + 15] for i in objects], 1)
    goals = torch.stack([goal[:, i.goal : i.goal + 3] for i in objects], 1)
    way = (goals - seen[..., :3]) * _LENGTH
    quarter = 4 * seen[..., 8:9]
    scaled = (seen - seen.new_tensor(_OBJECT_CENTRE)) * seen.new_tensor(_OBJECT_SCALE)
    tilt, rest = scaled[..., 6:8].clamp(-1, 1), scaled[..., 9:]
    length = way.norm(dim=-1, keepdim=True)
    parts = [scaled[..., :6], way, tilt, quarter.sin(), quarter.cos(), rest, length]
    return torch.cat(parts, -1).clamp(-10, 10)
