"""The hybrid generator, asked anew: which object moves next, and where to.

The paper's encoder is one Laplace over all objects at once. Between two stable arrangements one
object moves (others perhaps with it), and which one is a choice among few: one Laplace must
average over the choices, a mixture need not. So the explicit encoder is here

    p(subgoal | s, g) = sum_ik w_ik(s, g) prod_j Laplace(subgoal_j; mean_ikj, scale_ikj),

component ik being "object i moves, in the k-th of a few ways", with mean_ikj = place_j +
gate_ikj (goal_j - place_j) + shift_ikj: an object stays, goes to its goal, or is put somewhere
else. A single way would have to lie between the places where an object may go: a drawer half open.
It is built from pairs of objects, so that interchangeable objects share all parameters. The
implicit decoder, the likelihood and the divergence are the paper's.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pretrain.config import MoversConfig
from pretrain.features import object_tokens, scaled_robot
from pretrain.layout import Layout
from pretrain.networks import MLP
from pretrain.proposers import laplace
from pretrain.proposers.proposer import Info, SubgoalProposer

SCALE = 10.0
"""Lengths are in decimetres inside the networks."""
_LEAST_SCALE, _MOST_SCALE = 0.02, 2.0


class Movers(SubgoalProposer):
    """Mixture over movers; see the module."""

    _kind: Tensor
    _same: Tensor
    _columns: Tensor
    _places: Tensor

    def __init__(self, layout: Layout, config: MoversConfig) -> None:
        super().__init__()
        self._layout, self.config = layout, config
        count = len(layout.objects)
        kinds = torch.tensor([item.kind for item in layout.objects])
        self.register_buffer("_kind", nn.functional.one_hot(kinds, layout.kinds).float())
        goals = torch.tensor([item.goal for item in layout.objects])
        places = torch.tensor([item.observation for item in layout.objects])
        for name, first in (("_columns", goals), ("_places", places)):
            self.register_buffer(name, first[:, None] + torch.arange(3), persistent=False)
        token = 20 + layout.kinds
        width = config.width
        pair = layout.robot_dim + 2 * token + _RELATION_DIM + 1
        # Two bodies: densities of places are worth many nats, the choice of an object less than
        # one, and would be drowned out in a shared one.
        self.choice = MLP(pair, (width,), width)
        self.weight = MLP(layout.robot_dim + token + 2 * width, (width,), config.modes)
        self.moves = MLP(pair, (width, width), 7 * config.modes)
        self.decoder = MLP(layout.observation_dim + 3 * count, (width,) * 2, 3 * count)
        self.register_buffer("_same", torch.eye(count))

    def components(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-weights (B, M), means (B, M, n, 3) and scales likewise, in decimetres.

        The means are relative to where the objects are.
        """
        batch, count = len(observation), len(self._layout.objects)
        robot = scaled_robot(observation[:, : self._layout.robot_dim])
        tokens = object_tokens(self._layout, observation, goal)
        kind = self._kind.expand(batch, -1, -1)
        tokens = torch.cat([tokens, kind], -1)
        mover = tokens[:, :, None].expand(-1, -1, count, -1)
        other = tokens[:, None].expand(-1, count, -1, -1)
        same = self._same.expand(batch, -1, -1)[..., None]
        around = robot[:, None, None].expand(-1, count, count, -1)
        relation = _relations(tokens[..., :3], tokens[..., 6:9])
        pairs = torch.cat([around, mover, other, relation, same], -1)
        choice = torch.relu(self.choice(pairs))
        pooled = torch.cat([choice.mean(2), choice.amax(2)], -1)
        context = torch.cat([robot[:, None].expand(-1, count, -1), tokens, pooled], -1)
        logits = self.weight(context).flatten(1)
        moves = self.moves(pairs).unflatten(-1, (self.config.modes, 7)).movedim(-2, 2)
        gate, shift, spread = moves.split([1, 3, 3], -1)
        way = other[..., 6:9].unsqueeze(2)
        mean = torch.sigmoid(gate) * way + shift
        scale = nn.functional.softplus(spread).clamp(max=_MOST_SCALE) + _LEAST_SCALE
        return logits.log_softmax(-1), mean.flatten(1, 2), scale.flatten(1, 2)

    def _of(self, mover: Tensor, each: Tensor) -> Tensor:
        """Return (B, modes) of (B, M): the components in which object ``mover`` (B,) moves."""
        rows = torch.arange(len(mover), device=mover.device)
        return each.unflatten(1, (-1, self.config.modes))[rows, mover]

    def _relative(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return (B, n, 3): goals relative to where the objects are, decimetres."""
        return (goal[:, self._columns] - self._place(observation)) * SCALE

    def _place(self, observation: Tensor) -> Tensor:
        return observation[:, self._places]

    def propose(self, observation: Tensor, goal: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Draw candidates; the first M are the means of the components, likeliest first."""
        with torch.no_grad():
            log_weight, mean, scale = self.components(observation, goal)
            batch, movers = log_weight.shape
            order = log_weight.argsort(1, descending=True)[:, :count]
            which = order
            if count > movers:
                drawn = torch.multinomial(log_weight.exp(), count - movers, replacement=True)
                which = torch.cat([order, drawn], 1)
            rows = torch.arange(batch)[:, None]
            chosen = mean[rows, which]
            spread = scale[rows, which] * self.config.temperature
            candidate = laplace.sample(chosen, spread)
            candidate[:, :movers] = chosen[:, :movers]
            log_prob = log_weight.gather(1, which)
            places = self._place(observation)[:, None] + candidate / SCALE
            result = goal[:, None].repeat(1, which.shape[1], 1)
            result[..., self._columns] = places
            return result, log_prob

    def loss(self, observation: Tensor, goal: Tensor, subgoal: Tensor) -> tuple[Tensor, Info]:
        """Return beta L_HS + reconstruction + divergence, weighted as configured."""
        log_weight, mean, scale = self.components(observation, goal)
        target = self._relative(observation, subgoal)
        scales = scale.flatten(2)
        each = laplace.log_probs(target.flatten(1)[:, None], mean.flatten(2), scales)
        # Who moved is known in hindsight, the object that went furthest; in which way is not.
        mover = target.norm(dim=-1).argmax(1)
        joint = self._of(mover, log_weight + each.sum(-1))
        likelihood = joint.logsumexp(-1)
        # The gradient of a mixture is that of its parts by their shares.
        share = joint.softmax(-1).detach()
        parts = self._of(mover, log_weight + laplace.evened(each, scales).sum(-1))
        learned = (share * parts).sum(-1)
        drawn = self._place(observation)[:, None] * SCALE + laplace.sample(mean, scale)
        state = observation[:, None].expand(-1, drawn.shape[1], -1)
        guess = self.decoder(torch.cat([state, drawn.flatten(2)], -1))
        true_goal = goal[:, self._columns].flatten(1)[:, None] * SCALE
        # A unit-scale Laplace in decimetres, constants dropped.
        missed = (guess - true_goal).abs().sum(-1)
        weight = log_weight.exp()
        reconstruction = (weight * missed).sum(1)
        divergence = laplace.kl_to_standard_normal(mean.flatten(2), scale.flatten(2))
        divergence = (weight * divergence).sum(1)
        config = self.config
        loss = (
            -config.likelihood * learned
            + config.reconstruction * reconstruction
            + config.divergence * divergence
        ).mean()
        return loss, {
            "log_likelihood": likelihood.detach().mean(),
            "reconstruction_error": reconstruction.detach().mean(),
            "divergence": divergence.detach().mean(),
        }


_RELATION_DIM = 12
_NEAR = 0.3
"""Decimetres within which one thing is on the place of another: less than the edge of a block."""


def _relations(place: Tensor, way: Tensor) -> Tensor:
    """Return (B, n, n, 12): object j, and its goal, seen from object i and from its goal.

    What has to move first is a matter of these: who lies on whose goal, whose goal is below whose.
    Three differences, and for each how near the two are in all.

    Args:
        place: (B, n, 3) decimetres.
        way: (B, n, 3) from there to the goals.
    """
    goal = place + way
    pairs = ((place, place), (goal, place), (goal, goal))
    apart = torch.stack([theirs[:, None] - mine[:, :, None] for mine, theirs in pairs], -2)
    near = torch.exp(-(apart / _NEAR).square().sum(-1))
    return torch.cat([apart.flatten(-2), near], -1)
