"""The codebook: nearest codes, straight-through gradients, codes that follow their data.

Codes are moving averages of the vectors assigned to them instead of parameters (van den Oord et
al. 2017, appendix A.1): they need no learning rate, and settle faster. A code that nothing is
assigned to would stay where it is for ever; after a while it is put onto a vector of the batch.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_SMOOTHING = 1e-5
_ROWS = 256
"""Whose distances to all codes are looked at together: they stay in a processor's cache."""


class Codebook(nn.Module):
    """K codes of D components.

    Args:
        codes: K.
        dim: D.
        decay: of the moving averages.
        revive_after: updates for which a code may go unused.
    """

    code: Tensor
    _count: Tensor
    _total: Tensor
    _idle: Tensor

    def __init__(self, codes: int, dim: int, decay: float, revive_after: int) -> None:
        super().__init__()
        self._decay, self._revive_after = decay, revive_after
        self.register_buffer("code", torch.zeros(codes, dim))
        self.register_buffer("_count", torch.ones(codes))
        self.register_buffer("_total", torch.zeros(codes, dim))
        # All are overdue at the start: the first update puts them onto its data.
        self.register_buffer("_idle", torch.full((codes,), revive_after, dtype=torch.int64))

    def __len__(self) -> int:
        return len(self.code)

    @torch.no_grad()
    def nearest(self, vectors: Tensor) -> Tensor:
        """Return the indices (N,) of the codes nearest to (N, D) vectors."""
        columns = self.code.T.contiguous()
        return torch.cat([_nearest(part, columns) for part in vectors.split(_ROWS)])

    def forward(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Return the codes (N, D) nearest to (N, D) vectors, and their indices (N,).

        The gradient of the codes is passed straight through to the vectors.
        """
        index = self.nearest(vectors)
        chosen = self.code[index]
        return vectors + (chosen - vectors).detach(), index

    @torch.no_grad()
    def follow(self, vectors: Tensor, index: Tensor) -> int:
        """Let the codes follow the (N, D) vectors assigned to them; return how many were revived.

        Args:
            vectors: of the batch.
            index: (N,) what ``nearest`` gave.
        """
        count = torch.bincount(index, minlength=len(self)).to(vectors.dtype)
        total = torch.zeros_like(self.code).index_add_(0, index, vectors)
        self._count.lerp_(count, 1.0 - self._decay)
        self._total.lerp_(total, 1.0 - self._decay)
        self._idle.add_(1).masked_fill_(count > 0, 0)
        dead = torch.nonzero(self._idle > self._revive_after).squeeze(1)
        if len(dead):
            drawn = torch.randint(len(vectors), (len(dead),), device=vectors.device)
            self._count[dead] = 1.0
            self._total[dead] = vectors[drawn]
            self._idle[dead] = 0
        self.code.copy_(self._total / (self._count + _SMOOTHING)[:, None])
        return len(dead)


def _nearest(vectors: Tensor, columns: Tensor) -> Tensor:
    """Return the indices (N,) of the codes nearest to (N, D) vectors, of the (D, K) codes.

    Without a product of matrices, which may be of less than fp32 (``pretrain.device``): the codes
    of an image must be the same wherever it is encoded. It is no slower.
    """
    # |v|^2 is the same for all codes.
    apart = columns.square().sum(0).repeat(len(vectors), 1)
    for mine, theirs in zip(vectors.T, columns, strict=True):
        apart.addcmul_(mine[:, None], theirs, value=-2.0)
    return apart.argmin(1)
