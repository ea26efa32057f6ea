"""Error dynamics of a schedule, row by row."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import symmetrize

# Of the damping: smaller entries between the modes of the stiffness are rounding of its root.
_COUPLED = 1e-12
# Matrices of 27 outputs that stay in the cache together.
_AT_ONCE = 64


class Modes(NamedTuple):
    """Rows along their own axes, for coordinates ``q = Q' C' e`` in which the mass ``M = C C'`` is 1.

    The stiffness ``C^-1 K C'^-1 = Q diag(squared) Q'`` is diagonal there. ``damping`` is, too, if it is one number for
    each mode, (n, d), as that made from stiffness and mass; else it couples them, (n, d, d).
    """

    squared: Float[Tensor, "n d"]
    axes: Float[Tensor, "n d d"]
    damping: Float[Tensor, "n d *d"]


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

    time: Float[Tensor, "*a n"]
    stiffness: Float[Tensor, "*a n d d"]
    damping: Float[Tensor, "*a n d d"]
    mass: Float[Tensor, "*a m d d"]
    transport: Float[Tensor, "*a n d d"] | None = None

    @property
    def is_plain(self) -> bool:
        """Whether one inertia holds for all rows and nothing is carried along."""
        return len(self.mass) == 1 and self.transport is None

    @cached_property
    def modes(self) -> Modes:
        """Rows along their own axes, each with its own mass."""
        squared, axes = torch.linalg.eigh(self.per_mass(self.stiffness))
        damping = symmetrize(axes.mT @ self.per_mass(self.damping) @ axes)
        own = damping.diagonal(dim1=-2, dim2=-1)
        coupled = (damping - torch.diag_embed(own)).abs().amax((1, 2)) > _COUPLED * damping.abs().amax((1, 2))
        return Modes(squared, axes, damping if bool(coupled.any()) else own)

    @staticmethod
    def side_by_side(schedules: Sequence["ErrorDynamics"]) -> "ErrorDynamics":
        """Rows (a, n, d, d) of a schedules of as many rows; what is restricted then are schedules."""
        parts = ([getattr(each, field.name) for each in schedules] for field in fields(ErrorDynamics))
        return ErrorDynamics(*(None if part[0] is None else torch.stack(part) for part in parts))  # type: ignore[arg-type]

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
        """Maps over each of the n - 1 intervals with everything held, of a state whose squared length is the energy.

        The state, of s = 2 d, is ``(w q, q')`` in the modes of each row, w the roots of their ``squared``. As in the
        simulated robot, the desired motion stands still in the interval, and what it carries along turns at its end.
        """
        squared, axes, damping = self.modes
        frequency, d = squared.sqrt(), squared.shape[-1]
        upper = torch.linalg.cholesky(self.mass).mT.expand_as(axes)
        to_modes = axes.mT @ upper
        from_modes = torch.linalg.solve_triangular(upper[:-1], axes[:-1], upper=True)
        maps = frequency.new_zeros(len(axes) - 1, 2 * d, 2 * d)
        for rows in torch.arange(len(maps)).split(_AT_ONCE):
            step = (self.time[rows + 1] - self.time[rows])[:, None, None]
            held = _held(frequency[rows], damping[rows], step)
            back = from_modes[rows]
            turned = back if self.transport is None else torch.linalg.matrix_exp(self.transport[rows] * step) @ back
            of_deviation = frequency[rows + 1, :, None] * (to_modes[rows + 1] @ turned) / frequency[rows, None, :]
            maps[rows, :d] = of_deviation @ held[:, :d]
            maps[rows, d:] = to_modes[rows + 1] @ back @ held[:, d:]
        return maps


def _held(frequency: Float[Tensor, "k d"], damping: Float[Tensor, "k d *d"], step: Float[Tensor, "k 1 1"]) -> Tensor:
    """Exponentials of ``[[0, w], [-w, -D]]`` over these steps: of each mode by itself where none is coupled."""
    if damping.ndim == 3:
        across = torch.diag_embed(frequency)
        upper = torch.cat([torch.zeros_like(across), across], dim=-1)
        return torch.linalg.matrix_exp(torch.cat([upper, torch.cat([-across, -damping], dim=-1)], dim=-2) * step)
    rate = torch.stack([torch.zeros_like(frequency), frequency, -frequency, -damping], dim=-1).unflatten(-1, (2, 2))
    blocks = torch.linalg.matrix_exp(rate * step[..., None])  # (k, d, 2, 2)
    return torch.diag_embed(blocks.movedim(1, -1)).movedim(-2, -3).flatten(-2).flatten(-3, -2)
