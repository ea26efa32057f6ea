"""Error dynamics of a schedule, row by row, and the largest growth of a deviation over a part of it."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import block_matrix, symmetrize

# Share of the damping below which entries between the modes of the stiffness are rounding of its root.
_COUPLED = 1e-12
# Matrices of 27 outputs that stay in the cache together.
_AT_ONCE = 64
# Rows between which growth is looked for, and parts that are followed from row to row: enough for 27 outputs at 2,701
# rows to find what all of them do.
_MAX_ROWS, _MAX_PARTS = 150, 64


@dataclass(frozen=True)
class ErrorDynamics:
    """Dynamics ``M v' + D v + K e = 0``, ``e' = v + W e`` at n rows, with deviations e of position and v of velocity.

    A rotation deviates by a rotation vector in world axes, which the desired angular velocity w carries along:
    ``W = blkdiag(0, [w]x)``, the ``transport``. There are m = n masses, or one for all rows. Coriolis forces count as
    compensated.
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
    def modes(self) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"], Float[Tensor, "n d *d"]]:
        """Squared frequencies, axes Q and damping of rows in coordinates ``q = Q' C' e``, where ``M = C C'`` is 1.

        The stiffness ``C^-1 K C'^-1 = Q diag(squared) Q'`` is diagonal there. The damping is, too, if it is one number
        for each mode, (n, d), as that made from stiffness and mass; else it couples them, (n, d, d).
        """
        squared, axes = torch.linalg.eigh(self.per_mass(self.stiffness))
        damping = symmetrize(axes.mT @ self.per_mass(self.damping) @ axes)
        own = damping.diagonal(dim1=-2, dim2=-1)
        coupled = (damping - torch.diag_embed(own)).abs().amax((1, 2)) > _COUPLED * damping.abs().amax((1, 2))
        return squared, axes, damping if bool(coupled.any()) else own

    def restrict(self, rows: Tensor) -> "ErrorDynamics":
        """Dynamics at the selected rows (...), or schedules of those side by side."""
        transport = None if self.transport is None else self.transport[rows]
        mass = self.mass[rows.new_zeros(*rows.shape[:-1], 1) if len(self.mass) == 1 else rows]
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
        return torch.linalg.matrix_exp(block_matrix(torch.zeros_like(across), across, -across, -damping) * step)
    rate = torch.stack([torch.zeros_like(frequency), frequency, -frequency, -damping], dim=-1).unflatten(-1, (2, 2))
    blocks = torch.linalg.matrix_exp(rate * step[..., None])  # (k, d, 2, 2)
    return torch.diag_embed(blocks.movedim(1, -1)).movedim(-2, -3).flatten(-2).flatten(-3, -2)


def largest_gain(steps: Float[Tensor, "k s s"]) -> float:
    """Largest norm of a product of successive maps, in coordinates in which the squared length is the energy.

    That is ``||P_j^1/2 Phi(j, i) P_i^-1/2||`` over i < j, with P = diag(K, M) and the exact maps Phi.
    In long schedules it is searched between 150 rows, closer together where the energy changes more, and then among all
    rows around the beginning and end of such a part.
    """
    every = torch.arange(len(steps) + 1)
    if len(steps) <= _MAX_ROWS:
        return _largest_growth(steps)[0]
    identity = torch.eye(steps.shape[-1]).to(steps)
    changes = [torch.linalg.matrix_norm(each.mT @ each - identity) for each in steps.split(_AT_ONCE)]
    change = torch.cat(changes).cumsum(0)
    shares = torch.linspace(0.0, float(change[-1]), _MAX_ROWS + 1).to(change)[1:-1]
    rows = torch.cat([every[:1], torch.searchsorted(change, shares) + 1, every[-1:]]).unique()
    ends = _largest_growth(_products(steps, rows))[1:]
    around = [every[rows[max(end - 1, 0)] : rows[min(end + 1, len(rows) - 1)] + 1] for end in ends]
    return _largest_growth(_products(steps, torch.cat([rows, *around]).unique()))[0]


def _largest_growth(steps: Float[Tensor, "k s s"]) -> tuple[float, int, int]:
    """Growth of the part that grows the most, and its first and last rows."""
    begun, identity = steps[:0], torch.eye(steps.shape[-1]).to(steps)
    since, largest, part = torch.empty(0, dtype=torch.long), 1.0, (0, 0)
    for row, each in enumerate(steps):
        begun, since = each @ torch.cat([begun, identity[None]]), torch.cat([since, torch.tensor([row])])
        squared = begun.mT @ begun
        # A part that has not grown so far gains no more than one that begins here. Whether all eigenvalues are below
        # a limit is seen sooner than what they are.
        grown = torch.linalg.cholesky_ex((1.0 + 1e-12) * identity - squared).info > 0
        begun, squared, since = begun[grown], squared[grown], since[grown]
        record = torch.linalg.cholesky_ex(largest * (1.0 + 1e-12) * identity - squared).info > 0
        if bool(record.any()):
            values = torch.linalg.eigvalsh(squared[record])[:, -1]
            largest, part = float(values.max()), (int(since[record][values.argmax()]), row + 1)
        if len(begun) > _MAX_PARTS:
            kept = torch.linalg.matrix_norm(begun).topk(_MAX_PARTS).indices
            begun, since = begun[kept], since[kept]
    return math.sqrt(largest), *part


def _products(steps: Float[Tensor, "k s s"], rows: Int64[Tensor, " c1"]) -> Float[Tensor, "c s s"]:
    """Maps from each of the selected rows to the next one."""
    begins, lengths = rows[:-1], rows.diff()
    products = steps[begins]
    for later in range(1, int(lengths.max())):
        longer = lengths > later
        products[longer] = steps[begins[longer] + later] @ products[longer]
    return products
