"""One function of the state that falls at every row of a schedule, in whatever order they come."""

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.control.stability.dynamics import ErrorDynamics
from torch_pbd.control.stability.lyapunov import evenly, minimize_convex, smallest_eigenvalues
from torch_pbd.linalg import symmetrize, tril_to_vector, vector_to_tril
from torch_pbd.optim.batch import minimize_batch

# Of the summands of a matrix whose smallest eigenvalue must be positive: a margin over rounding, 1e-13 of them.
_ROUNDING = 1e-10
# Of cuts, and rows of the first; where K and D commute one is enough, and three have been the most that was needed.
_ROUNDS, _N_CUT = 12, 200
# Outputs up to which a function with axes of its own is searched for, and rows that it is searched among at first.
_MAX_OUTPUTS, _N_ROWS = 9, 24
# The largest eigenvalue of all is smoothed, by and by less, over these shares of the natural frequency.
_TEMPERATURES: tuple[float, ...] = (0.1, 0.01, 0.003)
_MAX_ITER = 60  # at each of them
_MAX_SEARCHES = 6
_NEAR = 0.03  # of the rate among some rows, by which that of all may be lower
_AT_ONCE = 256  # rows, which bounds the memory
_UNBOUNDED = 1e6  # rate, of natural frequencies, that stands for none


def common_function(dynamics: ErrorDynamics) -> tuple[float, float]:
    """Rate, in 1/s, at which the root of one function falls at least, and the speed up to which one falls.

    Under any sequence of the rows (K, D, M, W) and blends of them, each held for any time or changing continuously, W
    multiplied by anything from 0, where the schedule waits, to that speed. NaN and 0 where none is found.

    Notes
    -----
    With one mass the rate matrix ``A = [[W, 1], [-M^-1 K, -M^-1 D]]`` of z = (e, v) is linear in (K, D, W), and so is
    ``A'P + P A``: what is negative definite for rows is so for their blends. Where masses differ it is not. But along
    any motion, whose acceleration is a,

        d/dt z'Pz = 2 z'P (v + W e, a) - 2 (e, v, a)'Y (K e + D v + M a),    for any Y of shape (3 d, d),

    because the last bracket is zero; and the right side is linear in (K, D, M, W). What one Y makes negative definite
    in (e, v, a) for rows is so for their blends. The a that is the worst is put in, which leaves a form in z.
    """
    rows, frequency = scaled(dynamics)
    function = isotropic_function(rows) if dynamics.is_plain else None
    if function is None and rows.stiffness.shape[-1] <= _MAX_OUTPUTS:
        function = searched_function(rows)
    if function is None:
        return math.nan, 0.0
    largest = function.largest(rows)
    if largest >= 0.0:
        return math.nan, 0.0
    fastest, n = math.inf, len(dynamics.time)
    for part in torch.arange(n).split(_AT_ONCE) if dynamics.transport is not None else ():
        moving, at_rest = (function.change(rows.restrict(some)) for some in (part, part + n))
        carried = -float(smallest_eigenvalues(at_rest - moving, -at_rest).min())
        fastest = min(fastest, 1.0 / carried if carried > 0.0 else math.inf)
    return -largest * frequency, fastest


def scaled(dynamics: ErrorDynamics) -> tuple[ErrorDynamics, float]:
    """Rows in units of their mean mass and of a frequency between their softest and their stiffest axis.

    Where something is carried along, they come twice: then without it, as where the schedule waits.
    """
    mean = dynamics.mass.mean(0, keepdim=True)
    stiffness, damping, mass = (
        dynamics.per_mass(each, mean) for each in (dynamics.stiffness, dynamics.damping, dynamics.mass)
    )
    values = torch.linalg.eigvalsh(stiffness)
    frequency = math.sqrt(math.sqrt(float(values.min())) * math.sqrt(float(values.max())))
    rows = ErrorDynamics(dynamics.time, stiffness / frequency**2, damping / frequency, mass)
    if dynamics.transport is None:
        return rows, frequency
    upper = torch.linalg.cholesky(mean).mT
    transport = torch.linalg.solve_triangular(upper, upper @ dynamics.transport, upper=True, left=False) / frequency
    rows = replace(
        rows.restrict(torch.arange(len(rows.time)).repeat(2)), transport=torch.cat([transport, 0.0 * transport])
    )
    return rows, frequency


@dataclass(frozen=True)
class Function:
    """``|T z|^2`` with T upper triangular, and, where masses differ, ``blkdiag(T, 1)'^-1 Y``."""

    root: Float[Tensor, "s s"]
    multiplier: Float[Tensor, "t d"] | None = None

    def change(self, rows: ErrorDynamics) -> Float[Tensor, "n s s"]:
        """Symmetric matrices whose largest eigenvalue bounds the rate of ``|T z|``, relative to it."""
        zero, d = torch.zeros_like(rows.stiffness), rows.stiffness.shape[-1]
        transport = zero if rows.transport is None else rows.transport
        kinematic = torch.cat([transport, torch.eye(d).to(zero) + zero], dim=-1)
        pull = torch.cat([rows.stiffness, rows.damping], dim=-1)
        if self.multiplier is None:  # the mass is 1
            return symmetrize(self._per_root(self.root @ torch.cat([kinematic, -pull], dim=-2)))
        of_state, of_acceleration = self.multiplier.split([2 * d, d])
        change = self._per_root(self.root[:, :d] @ kinematic - of_state @ pull)
        coupling = self.root[:, d:] - of_state @ rows.mass - self._per_root(of_acceleration @ pull).mT
        # It is a concave function of the acceleration if this is positive definite, and largest at some.
        factor, failed = torch.linalg.cholesky_ex(2.0 * symmetrize(of_acceleration @ rows.mass))
        half = torch.linalg.solve_triangular(factor, coupling.mT, upper=False)
        change = symmetrize(change) + 0.5 * half.mT @ half
        return torch.where(failed[:, None, None] > 0, _UNBOUNDED * torch.eye(2 * d).to(change), change)

    def _per_root(self, matrix: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self.root, matrix, upper=True, left=False)

    def eigenvalues(self, rows: ErrorDynamics) -> Float[Tensor, "n r"]:
        """Eigenvalues of these matrices."""
        return torch.linalg.eigvalsh(self.change(rows))

    def above(self, rows: ErrorDynamics, limit: float) -> Int64[Tensor, " k"]:
        """Rows with an eigenvalue above a limit: a Cholesky factor tells sooner than eigenvalues do."""
        found = []
        for part in torch.arange(len(rows.time)).split(_AT_ONCE):
            change = self.change(rows.restrict(part))
            shifted = limit * torch.eye(change.shape[-1]).to(change) - change
            found.append(part[torch.linalg.cholesky_ex(shifted).info > 0])
        return torch.cat(found)

    def largest(self, rows: ErrorDynamics) -> float:
        """Largest eigenvalue of all rows, and what rounding may add to it."""
        some = self.eigenvalues(rows.restrict(evenly(len(rows.time), _N_ROWS)))
        above = self.above(rows, float(some.max()))
        values = torch.cat([some, self.eigenvalues(rows.restrict(above))])
        return float(values.max()) + _ROUNDING * float(values.abs().max())


def searched_function(rows: ErrorDynamics) -> Function | None:
    """Function of the largest rate, by BFGS on a smoothed maximum of the eigenvalues of some rows, then of more."""
    d = rows.stiffness.shape[-1]
    root = torch.kron(torch.tensor([[1.0, 0.5], [0.0, math.sqrt(0.75)]]), torch.eye(d)).to(rows.time)
    free = [tril_to_vector(root.mT)]
    if len(rows.mass) > 1:  # at first ``Y M a`` is ``P (0, a)`` for the mean mass, and as much of a as will do
        free += [torch.cat([root[:, d:], 0.3 * torch.eye(d).to(root)]).flatten()]
    at, inverse = torch.cat(free)[None], torch.eye(sum(map(len, free))).to(root)[None]
    chosen, temperatures = evenly(len(rows.time), _N_ROWS), _TEMPERATURES
    for _ in range(_MAX_SEARCHES):
        some = rows.restrict(chosen)
        for temperature in temperatures:
            objective = partial(_smoothed, rows=some, temperature=temperature)
            at, report = minimize_batch(objective, at, max_iter=_MAX_ITER, inverse_hessian=inverse)
            inverse = report.inverse_hessian
        found = _unpacked(at[0], d)
        largest = float(found.eigenvalues(some).max())
        if largest >= 0.0:
            return None
        above = found.above(rows, (1.0 - _NEAR) * largest)
        above = above[~torch.isin(above, chosen)]
        if not len(above):
            break
        chosen, temperatures = torch.cat([chosen, above[evenly(len(above), _N_ROWS)]]), _TEMPERATURES[-2:]
    return found


def _unpacked(free: Float[Tensor, " p"], d: int) -> Function:
    root, multiplier = free.split([d * (2 * d + 1), len(free) - d * (2 * d + 1)])
    return Function(vector_to_tril(root).mT, multiplier.unflatten(0, (3 * d, d)) if len(multiplier) else None)


def _smoothed(
    free: Float[Tensor, "a p"], _: Tensor, *, rows: ErrorDynamics, temperature: float
) -> tuple[Float[Tensor, " a"], Float[Tensor, "a p"]]:
    """Smoothed largest eigenvalue, not below it, and its gradient."""
    with torch.enable_grad():
        leaf = free.detach().requires_grad_()
        values = [_unpacked(each, rows.stiffness.shape[-1]).eigenvalues(rows).flatten() for each in leaf]
        loss = torch.stack([temperature * torch.logsumexp(each / temperature, 0) for each in values])
        return loss.detach(), torch.autograd.grad(loss.sum(), leaf)[0]


def isotropic_function(rows: ErrorDynamics) -> Function | None:
    """Function to which no axis is special, for a mass of 1, if there is one.

    Notes
    -----
    ``V = a |y|^2 + 2 b y'v + |v|^2`` does not depend on axes. ``-dV/dt`` is the quadratic form of
    ``[[2 b K, K + b D - a], [K + b D - a, 2 D - 2 b]]`` in (y, v), linear in (K, D): what holds for the pairs holds for
    their blends. It is positive for b > 0 if and only if ``T = 4 b (D - b) - (K + b D - a) K^-1 (K + b D - a)`` is, its
    Schur complement times 2 b; V itself then is, because the motion under constant gains dies out (Lyapunov). T is
    concave in (a, b), so the smallest of all eigenvalues is too, and it is maximized by cuts: ``z'T z`` of the
    eigenvectors z found so far is an upper bound. The first are those of K.
    """
    stiff, damp = rows.stiffness, rows.damping
    values, axes = torch.linalg.eigh(stiff)
    compliance = (axes / values.unsqueeze(-2)) @ axes.mT
    lag, identity = damp @ compliance, torch.eye(stiff.shape[-1]).to(stiff).expand_as(stiff)
    terms = torch.stack(  # T by its monomials a, b, b^2, 1, a b, a^2
        [2.0 * identity, 2.0 * damp, -4.0 * identity - lag @ damp, -stiff, lag + lag.mT, -symmetrize(compliance)]
    )
    least = float(torch.linalg.eigvalsh(damp)[:, 0].min())
    if least <= 0.0 or not bool(torch.isfinite(terms).all()):
        return None
    # Where T is positive b is below every D, and a about between the smallest K and the largest K + b D. They are
    # searched by their logarithms, which stiffnesses of many powers of ten need, and which moves no maximum.
    largest = stiff.shape[-1] * float(stiff.abs().max() + least * damp.abs().max())
    of_a = math.log(1e-3 * float(values.min())), math.log(largest)
    of_b = math.log(1e-6 * least), math.log(least)
    few = evenly(len(axes), _N_CUT)
    cuts = _along(terms[:, few], axes[few])
    for _ in range(_ROUNDS):

        def excess(log_a: float, log_b: float, cuts: Tensor = cuts) -> float:
            return -float((_monomials(log_a, log_b, cuts) @ cuts).min())

        def best(log_b: float) -> float:
            return minimize_convex(lambda x: excess(x, log_b), *of_a, n_steps=32)

        log_b = minimize_convex(lambda x: excess(best(x), x), *of_b, n_steps=32)
        log_a = best(log_b)
        weights = _monomials(log_a, log_b, terms)
        negligible = _ROUNDING * float(weights.abs() @ terms.abs().amax((1, 2, 3)))
        if excess(log_a, log_b) >= -negligible:
            return None
        eigenvalues, vectors = torch.linalg.eigh(symmetrize(torch.tensordot(weights, terms, 1)))
        if float(eigenvalues.min()) > negligible:
            a, b = math.exp(log_a), math.exp(log_b)
            return Function(
                torch.linalg.cholesky(torch.kron(torch.tensor([[a, b], [b, 1.0]]).to(stiff), identity[0])).mT
            )
        cuts = torch.cat([cuts, _along(terms, vectors[..., :1])], dim=1)
    return None


def _monomials(log_a: float, log_b: float, like: Tensor) -> Tensor:
    a, b = math.exp(log_a), math.exp(log_b)
    return torch.tensor([a, b, b * b, 1.0, a * b, a * a]).to(like)


def _along(terms: Float[Tensor, "k n d d"], vectors: Float[Tensor, "n d m"]) -> Float[Tensor, "k nm"]:
    return (vectors * (terms @ vectors)).sum(-2).flatten(1)
