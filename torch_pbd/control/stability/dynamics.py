"""Error dynamics of a schedule, row by row."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.simulation.ticks import transition
from torch_pbd.linalg import symmetrize

# Matrices of 27 outputs that stay in the cache together.
_AT_ONCE = 64


@dataclass(frozen=True)
class ErrorDynamics:
    """``M v' + D v + K e = 0`` and ``e' = v + W e`` at n rows: the deviation e, and v that of the velocity.

    A rotation deviates by a rotation vector in world axes, which the desired angular velocity w carries along:
    ``W = blkdiag(0, [w]x)``. Coriolis forces are taken for compensated.

    Parameters
    ----------
    time : Tensor of shape (n,)
    stiffness, damping : Tensor of shape (n, d, d)
    mass : Tensor of shape (m, d, d)
        m = n, or 1 where it is one for all rows.
    transport : Tensor of shape (n, d, d), default=None
        W; None is none.
    """

    time: Float[Tensor, " n"]
    stiffness: Float[Tensor, "n d d"]
    damping: Float[Tensor, "n d d"]
    mass: Float[Tensor, "m d d"]
    transport: Float[Tensor, "n d d"] | None = None

    @property
    def is_plain(self) -> bool:
        """Whether one inertia holds for all rows and nothing is carried along."""
        return len(self.mass) == 1 and self.transport is None

    def restrict(self, rows: Tensor) -> "ErrorDynamics":
        """Some of the rows."""
        transport = None if self.transport is None else self.transport[rows]
        mass = self.mass if len(self.mass) == 1 else self.mass[rows]
        return ErrorDynamics(self.time[rows], self.stiffness[rows], self.damping[rows], mass, transport)

    def per_mass(self, gain: Float[Tensor, "n d d"], mass: Float[Tensor, "m d d"] | None = None) -> Tensor:
        """Gains as ``C^-1 G C'^-1``, where ``C C'`` is a mass: that of each row if none is given."""
        factor = torch.linalg.cholesky(self.mass if mass is None else mass)
        half = torch.linalg.solve_triangular(factor, gain, upper=False)
        return symmetrize(torch.linalg.solve_triangular(factor.mT, half, upper=True, left=False))

    def tick_maps(self) -> Float[Tensor, "k s s"]:
        """Maps of (e, v) over each of the n - 1 intervals with everything held, s = 2 d.

        As in the simulated robot, the desired motion stands still in the interval, and what it carries along turns at
        its end.
        """
        d, n_intervals = self.stiffness.shape[-1], len(self.time) - 1
        # Of (w e, v), whose rates are of one size, the exponential takes fewer products.
        scale = torch.ones(2 * d).to(self.stiffness)
        scale[:d] = torch.linalg.matrix_norm(self.per_mass(self.stiffness)).mean().sqrt()
        maps = self.stiffness.new_zeros(n_intervals, 2 * d, 2 * d)
        for rows in torch.arange(n_intervals).split(_AT_ONCE):
            pull = torch.cat([self.stiffness[rows], self.damping[rows]], dim=-1)
            maps[rows, d:] = -torch.linalg.solve(self.mass if len(self.mass) == 1 else self.mass[rows], pull)
            maps[rows, :d, d:] = torch.eye(d).to(maps)
            step = (self.time[rows + 1] - self.time[rows])[:, None, None]
            maps[rows] = transition(scale[:, None] * maps[rows] / scale * step, 1.0) / scale[:, None] * scale
            if self.transport is not None:
                maps[rows, :d] = transition(self.transport[rows] * step, 1.0) @ maps[rows, :d]
        return maps
