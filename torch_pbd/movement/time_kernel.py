"""Correlation of a demonstration along time: a time kernel for each output, nuggets, and loadings.

Whitened residuals ``z`` of the demonstrations, of unit covariance at each step, are modelled as ``g_t + eps_t`` in each
output: g has a kernel over time, eps_t is independent with a variance e_t, the nugget. One nugget for all steps would
have to be as large as where movements start or end at one point, which marginals mistrack, and would spoil all others.

The kernel has one length scale, or is the sum of two: slow variation and a small tremor. The slow part is proportional
to the deviation at each step, which whitening makes one. A tremor has a constant size in the units of the outputs,
however much people vary there: in whitened residuals it is large where the deviation is small, and in outputs with
little variance left of their own. A single kernel for all outputs must be as rough as the roughest of them, and draws
are then rougher and longer than demonstrations.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.kernels import correlation
from torch_pbd.linalg import safe_cholesky, symmetrize


class TimeKernel(nn.Module):
    """Correlation along the movement, learned on a grid of T steps from K demonstrations of d outputs.

    ``scales`` (d, 2) are the length scales of the slow part and of the tremor of each output, ``fine`` (d, T) is the
    variance of the tremor over that of the slow part, ``nugget`` (d, T) that of the independent part over both, and
    ``residual`` (K, T, d) are whitened residuals without holes. ``share`` is the weight of the kernel's correlation;
    the rest is that of the demonstrations' own residuals.
    """

    grid: Tensor
    scales: Tensor
    fine: Tensor
    nugget: Tensor
    residual: Tensor
    share: Tensor
    _weights: Tensor
    _left: Tensor

    def __init__(self, kernel: str, **buffers: Tensor) -> None:
        super().__init__()
        self.kernel = kernel
        for name, value in buffers.items():
            self.register_buffer(name, value)
        self._weigh()
        self.register_load_state_dict_post_hook(TimeKernel._weigh)

    def _weigh(self, *_: object) -> None:
        """Kernel weights of the smooth parts of all residuals, and the remainders of these: (d, T, K)."""
        rows, own = self.residual.permute(2, 1, 0), self._correlation(self.grid, self.grid)
        root = safe_cholesky(own + torch.diag_embed(self.nugget), name="the time kernel")
        self.register_buffer("_weights", torch.cholesky_solve(rows, root), persistent=False)
        self.register_buffer("_left", rows - own @ self._weights, persistent=False)

    def correlation(self, time: Float[Tensor, "*b n"], other: Float[Tensor, "*b m"]) -> Float[Tensor, "d *b n m"]:
        """Correlation between any times; nuggets are linear between steps, and equal times have correlation 1."""
        parts = torch.stack([self.nugget, self.fine])
        (own, fine), (nugget, other_fine) = (_interpolated(self.grid, parts, part) for part in (time, other))
        whole = smooth_correlation(time, other, self.scales, fine, other_fine, self.kernel)
        whole = whole + torch.where(time[..., None] == other[..., None, :], nugget[..., None, :], 0.0)
        return (1.0 + own).rsqrt()[..., None] * whole * (1.0 + nugget).rsqrt()[..., None, :]

    def loadings(self, time: Float[Tensor, " n"]) -> Float[Tensor, "n d K"]:
        """Residuals of the demonstrations at any times: smooth parts by the kernel, remainders linear between steps."""
        left = _interpolated(self.grid, self._left.mT, time)
        return (self._correlation(time, self.grid) @ self._weights + left.mT).transpose(0, 1)

    def _correlation(self, time: Tensor, other: Tensor) -> Float[Tensor, "d *b n m"]:
        own, fine = (_interpolated(self.grid, self.fine, part) for part in (time, other))
        return smooth_correlation(time, other, self.scales, own, fine, self.kernel)


def smooth_correlation(
    time: Tensor, other: Tensor, scales: Tensor, fine: Tensor, other_fine: Tensor, kernel: str
) -> Float[Tensor, "p *b n m"]:
    """Correlation, of unit variance, of a slow part and a tremor, between times (*b, n) and others (*b, m).

    There are p pairs ``scales`` (p, 2), and at each time the tremor's variance over the slow part's, (p, *b, n or m).
    """
    # Many share a length scale, and the exponentials dominate the cost.
    lengths, places = torch.unique(scales, return_inverse=True)
    apart = time[..., None] - other[..., None, :]
    each = correlation(apart.reshape(-1, 1), apart.new_zeros(1, 1), lengths[:, None], kernel)
    each = each.reshape(len(lengths), *apart.shape)
    slow = each[places[:, 0]]
    if not bool(fine.any()):
        return slow
    # In place, as memory traffic dominates.
    fast = each[places[:, 1]].mul_(fine.sqrt()[..., None] * other_fine.sqrt()[..., None, :])
    return slow.add_(fast).mul_((1.0 + fine).rsqrt()[..., None] * (1.0 + other_fine).rsqrt()[..., None, :])


def _interpolated(grid: Float[Tensor, " T"], values: Float[Tensor, "*c T"], time: Float[Tensor, "*b n"]) -> Tensor:
    """Values at other times, linear between steps and constant beyond them."""
    right = torch.searchsorted(grid, time.contiguous()).clamp(1, len(grid) - 1)
    weight = ((time - grid[right - 1]) / (grid[right] - grid[right - 1])).clamp(0.0, 1.0)
    return torch.lerp(values[..., right - 1], values[..., right], weight)


class LeftOut(NamedTuple):
    """Highest log likelihood of demonstrations left out in turn, its share, and their squared distances under it.

    Two demonstrations have no others to be judged by: their squares are of residuals.
    """

    log_likelihood: float
    share: float
    square: Float[Tensor, " K"]


def left_out(kernel: TimeKernel, shares: Sequence[float]) -> LeftOut:
    """Highest log likelihood of the demonstrations, each under the law of the others' residuals.

    In this law ``z = C^-1 y``, y has the covariance ``S = share R + (1 - share) / (K - 1) sum z z'`` over the
    others, and ``C_t = chol S_tt`` keeps the marginals: it bends the smooth part, at a cost where that has little
    variance. With the Gram matrix G of all under R^-1, ``M = G + a I``, ``a = share (K - 1) / (1 - share)`` and
    ``c = Z' R^-1 y``, the squared distance is ``(y' R^-1 y - c' M^-1 c) / share`` and the determinant that of M over
    the others, whose inverse follows from that of all by removing one row.
    """
    n_demos, n_steps, d = kernel.residual.shape
    if n_demos < 3:  # a single other demonstration has no covariance
        return LeftOut(0.0, shares[0], kernel.residual.square().sum((1, 2)))
    root = safe_cholesky(kernel.correlation(kernel.grid, kernel.grid), name="the correlation along the movement")
    residual = kernel.residual

    def whiten(rows: Float[Tensor, "K T d"]) -> Float[Tensor, "K s"]:
        return torch.linalg.solve_triangular(root, rows.permute(2, 1, 0), upper=False).flatten(0, 1).mT

    whitened = whiten(residual)
    gram, outer = symmetrize(whitened @ whitened.mT), residual[..., None] * residual[..., None, :]
    unit, others = torch.eye(d).to(gram), (outer.sum(0) - outer) / (n_demos - 1)

    def under(share: float) -> LeftOut:
        if share == 1.0:
            return LeftOut(-0.5 * float(gram.trace()), share, gram.diagonal())
        factor = torch.linalg.cholesky(share * unit + (1.0 - share) * others)
        inner = whiten((factor @ residual[..., None])[..., 0])
        ridge = share * (n_demos - 1) / (1.0 - share)
        inverse = torch.linalg.inv(gram + ridge * torch.eye(n_demos).to(gram))
        own = inverse.diagonal()
        cross = (inner @ whitened.mT).fill_diagonal_(0.0)  # one row a demonstration, without itself
        solved = cross @ inverse
        explained = (cross * solved).sum(1) - solved.diagonal().square() / own
        square = (inner.square().sum(1) - explained) / share
        # log det of share (I + G / a) over the others
        log_det = n_steps * d * math.log(share) - (n_demos - 1) * math.log(ridge) + own.log() - torch.logdet(inverse)
        value = float((factor.diagonal(dim1=-2, dim2=-1).log().sum((1, 2)) - 0.5 * (square + log_det)).sum())
        return LeftOut(value, share, square)

    best = max(map(under, shares), key=lambda each: each.log_likelihood)
    # The same for all shares, but not for all kernels.
    unit_log_det = n_demos * float(root.diagonal(dim1=1, dim2=2).log().sum())
    return best._replace(log_likelihood=best.log_likelihood - unit_log_det)
