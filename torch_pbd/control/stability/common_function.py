"""Common Lyapunov function of all rows of a schedule, which decays in whatever order they come."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.control.stability.dynamics import ErrorDynamics
from torch_pbd.linalg import evenly, least_eigenvalue, rows_below, symmetrize, tril_to_vector, vector_to_tril
from torch_pbd.optim.batch import minimize_batch

# Share of the summands of a matrix whose smallest eigenvalue must be positive: a margin over rounding, 1e-13 of them.
_ROUNDING = 1e-10
# Rounds of cuts, and rows of the first; where K and D commute one is enough, and three have been the most needed.
_ROUNDS, _N_CUT = 12, 200
# Outputs up to which a function with axes of its own is searched for, and rows that it is searched among at first.
_MAX_OUTPUTS, _N_ROWS = 9, 24
# The largest eigenvalue of all is smoothed, by and by less, over these shares of the natural frequency.
_TEMPERATURES: tuple[float, ...] = (0.1, 0.01, 0.003)
_MAX_ITER = 60  # BFGS iterations at each temperature
_MAX_SEARCHES = 6
_NEAR = 0.03  # share by which the rate over all rows may be lower than that among some
_GOLDEN, _N_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0, 45  # sections: 4e-10 of the interval
_UNBOUNDED = 1e6  # rate in natural frequencies that stands for an unbounded one


def common_function(dynamics: ErrorDynamics) -> tuple[float, float]:
    """Smallest decay rate in 1/s of the root of a common Lyapunov function, and the speed up to which one exists.

    It decays under any sequence of the rows (K, D, M, W) and their blends, each held for any time or changing
    continuously, with W times any factor from 0, where the schedule waits, to that speed. NaN and 0 if none is found.

    Notes
    -----
    With one mass the rate matrix ``A = [[W, 1], [-M^-1 K, -M^-1 D]]`` of z = (e, v) is linear in (K, D, W), and so is
    ``A'P + P A``: what is negative definite for rows is so for their blends. Where masses differ it is not. But along
    any motion, whose acceleration is a,

        d/dt z'Pz = 2 z'P (v + W e, a) - 2 (e, v, a)'Y (K e + D v + M a),    for any Y of shape (3 d, d),

    because the last bracket is zero; and the right side is linear in (K, D, M, W). What one Y makes negative definite
    in (e, v, a) for rows is so for their blends. The a that is the worst is put in, which leaves a form in z.
    """
    rate = isotropic_rate(dynamics) if dynamics.is_plain else math.nan
    if not math.isnan(rate):
        return rate, math.inf
    if dynamics.stiffness.shape[-1] > _MAX_OUTPUTS:
        return math.nan, 0.0
    rows, frequency = scaled(dynamics)
    function, n = searched_function(rows), len(dynamics.time)
    if function is None or (largest := function.largest(rows)) >= 0.0:
        return math.nan, 0.0
    if dynamics.transport is None:
        return -largest * frequency, math.inf

    def carried(some: Tensor, q: float, p: float) -> Tensor:
        moving, at_rest = (function.change(rows.restrict(each)) for each in (some, some + n))
        return (q - p) * at_rest - q * moving

    slowed = -least_eigenvalue(carried, n)[0]
    return -largest * frequency, 1.0 / slowed if slowed > 0.0 else math.inf


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
    if dynamics.transport is not None:
        upper = torch.linalg.cholesky(mean).mT
        transport = torch.linalg.solve_triangular(upper, upper @ dynamics.transport, upper=True, left=False) / frequency
        rows = rows.restrict(torch.arange(len(rows.time)).repeat(2))
        rows = replace(rows, transport=torch.cat([transport, 0.0 * transport]))
    return rows, frequency


@dataclass(frozen=True)
class Function:
    """``|T z|^2`` with T upper triangular, and, where masses differ, ``blkdiag(T, 1)'^-1 Y``."""

    root: Float[Tensor, "*a s s"]
    multiplier: Float[Tensor, "*a t d"] | None = None

    def change(self, rows: ErrorDynamics) -> Float[Tensor, "*a n s s"]:
        """Symmetric matrices whose largest eigenvalue bounds the rate of ``|T z|``, relative to it."""
        zero, d = torch.zeros_like(rows.stiffness), rows.stiffness.shape[-1]
        transport = zero if rows.transport is None else rows.transport
        kinematic = torch.cat([transport, torch.eye(d).to(zero) + zero], dim=-1)
        pull = torch.cat([rows.stiffness, rows.damping], dim=-1)
        root = self.root.unsqueeze(-3)
        if self.multiplier is None:  # the mass is 1
            return symmetrize(self._per_root(root @ torch.cat([kinematic, -pull], dim=-2)))
        of_state, of_acceleration = self.multiplier.unsqueeze(-3).split([2 * d, d], dim=-2)
        change = self._per_root(root[..., :d] @ kinematic - of_state @ pull)
        coupling = root[..., d:] - of_state @ rows.mass - self._per_root(of_acceleration @ pull).mT
        # It is a concave function of the acceleration if this is positive definite, and largest at some.
        factor, failed = torch.linalg.cholesky_ex(2.0 * symmetrize(of_acceleration @ rows.mass))
        half = torch.linalg.solve_triangular(factor, coupling.mT, upper=False)
        change = symmetrize(change) + 0.5 * half.mT @ half
        return torch.where(failed[..., None, None] > 0, _UNBOUNDED * torch.eye(2 * d).to(change), change)

    def _per_root(self, matrix: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self.root.unsqueeze(-3), matrix, upper=True, left=False)

    def eigenvalues(self, rows: ErrorDynamics) -> Float[Tensor, "*a n r"]:
        """Eigenvalues of the matrices of :meth:`change`."""
        return torch.linalg.eigvalsh(self.change(rows))

    def above(self, rows: ErrorDynamics, limit: float) -> Int64[Tensor, " k"]:
        """Indices of rows with an eigenvalue above a limit."""

        def pencil(some: Tensor, q: float, p: float) -> Tensor:
            return p * torch.eye(len(self.root)).to(self.root) - q * self.change(rows.restrict(some))

        return rows_below(pencil, -limit, len(rows.time))

    def largest(self, rows: ErrorDynamics) -> float:
        """Largest eigenvalue of all rows plus the most that rounding may add."""
        some = self.eigenvalues(rows.restrict(evenly(len(rows.time), _N_ROWS)))
        values = torch.cat([some, self.eigenvalues(rows.restrict(self.above(rows, float(some.max()))))])
        return float(values.max()) + _ROUNDING * float(values.abs().max())


def searched_function(rows: ErrorDynamics) -> Function | None:
    """Function of the largest rate, searched among some rows and then more, those above the eigenvalue bound."""
    chosen, at, inverse, temperatures = evenly(len(rows.time), _N_ROWS), None, None, _TEMPERATURES
    for _ in range(_MAX_SEARCHES):
        some = rows.restrict(chosen)
        at, inverse = search(rows.restrict(chosen[None]), at, inverse, temperatures)
        found = unpacked(at[0], rows.stiffness.shape[-1])
        largest = float(found.eigenvalues(some).max())
        if largest >= 0.0:
            return None
        above = found.above(rows, (1.0 - _NEAR) * largest)
        above = above[~torch.isin(above, chosen)]
        if not len(above):
            break
        chosen, temperatures = torch.cat([chosen, above[evenly(len(above), _N_ROWS)]]), _TEMPERATURES[-2:]
    return found


def search(
    rows: ErrorDynamics,
    at: Float[Tensor, "a p"] | None = None,
    inverse: Float[Tensor, "a p p"] | None = None,
    temperatures: tuple[float, ...] = _TEMPERATURES,
) -> tuple[Float[Tensor, "a p"], Float[Tensor, "a p p"]]:
    """Functions of the largest rate, and BFGS's estimate there, for rows (a, n, d, d) of a schedules side by side.

    By BFGS on a smoothed maximum of the eigenvalues, from a point and an estimate or from the beginning.
    """
    d = rows.stiffness.shape[-1]
    if at is None or inverse is None:
        root = torch.kron(torch.tensor([[1.0, 0.5], [0.0, math.sqrt(0.75)]]), torch.eye(d)).to(rows.time)
        free = [tril_to_vector(root.mT)]
        if rows.mass.shape[1] > 1:  # at first ``Y M a`` is ``P (0, a)`` for the mean mass, and as much of a as will do
            free += [torch.cat([root[:, d:], 0.3 * torch.eye(d).to(root)]).flatten()]
        at = torch.cat(free).repeat(len(rows.time), 1)
        inverse = torch.eye(at.shape[1]).to(at).expand(len(at), -1, -1)
    for temperature in temperatures:
        objective = partial(_smoothed, rows=rows, temperature=temperature)
        at, report = minimize_batch(objective, at, max_iter=_MAX_ITER, inverse_hessian=inverse)
        inverse = report.inverse_hessian
    return at, inverse


def unpacked(free: Float[Tensor, "*a p"], d: int) -> Function:
    """Function, or functions side by side, of the parameters that are searched."""
    root, multiplier = free.split([d * (2 * d + 1), free.shape[-1] - d * (2 * d + 1)], dim=-1)
    return Function(vector_to_tril(root).mT, multiplier.unflatten(-1, (3 * d, d)) if multiplier.shape[-1] else None)


def _smoothed(
    free: Float[Tensor, "a p"], which: Int64[Tensor, " a"], *, rows: ErrorDynamics, temperature: float
) -> tuple[Float[Tensor, " a"], Float[Tensor, "a p"]]:
    """Smoothed largest eigenvalue, not below it, and its gradient."""
    with torch.enable_grad():
        leaf = free.detach().requires_grad_()
        values = unpacked(leaf, rows.stiffness.shape[-1]).eigenvalues(rows.restrict(which)).flatten(1)
        loss = temperature * torch.logsumexp(values / temperature, 1)
        return loss.detach(), torch.autograd.grad(loss.sum(), leaf)[0]


def isotropic_rate(dynamics: ErrorDynamics) -> float:
    """Rate in 1/s of an isotropic Lyapunov function, for one mass; NaN if there is none.

    Notes
    -----
    ``V = a |y|^2 + 2 b y'v + |v|^2`` does not depend on axes, so that each row may be looked at along its own: modes
    that are not coupled are rows by themselves. ``-dV/dt`` is the quadratic form of
    ``[[2 b K, K + b D - a], [K + b D - a, 2 D - 2 b]]`` in (y, v), linear in (K, D): what holds for the pairs holds for
    their blends. It is positive for b > 0 if and only if ``T = 4 b (D - b) - (K + b D - a) K^-1 (K + b D - a)`` is, its
    Schur complement times 2 b; V itself then is, because the motion under constant gains dies out (Lyapunov). T is
    concave in (a, b), so the smallest of all eigenvalues is too, and it is maximized by cuts: ``z'T z`` of the
    eigenvectors z found so far is an upper bound. The first are those of K.
    """
    squared, _, damping = dynamics.modes
    frequency = math.sqrt(math.sqrt(float(squared.min())) * math.sqrt(float(squared.max())))
    stiff, damp, few = squared / frequency**2, damping / frequency, evenly(len(squared), _N_CUT)
    if damp.ndim == 2:
        few = (few[:, None] * damp.shape[1] + torch.arange(damp.shape[1])).flatten()
        stiff, damp = stiff.reshape(-1, 1), damp.reshape(-1, 1, 1)
    terms = _schur_terms(stiff, damp)
    sizes, least = terms.abs().amax((1, 2, 3)), float(torch.linalg.eigvalsh(damp).min())
    if least <= 0.0 or not bool(torch.isfinite(sizes).all()):
        return math.nan
    # Where T is positive b is below every D, and a about between the smallest K and the largest K + b D. They are
    # searched by their logarithms, which stiffnesses of many powers of ten need, and which moves no maximum.
    largest = dynamics.stiffness.shape[-1] * float(stiff.max() + least * damp.abs().max())
    of_a = math.log(1e-3 * float(stiff.min())), math.log(largest)
    of_b = math.log(1e-6 * least), math.log(least)
    cuts = terms[:, few].diagonal(dim1=-2, dim2=-1).flatten(1)
    for _ in range(_ROUNDS):

        def excess(log_a: float, log_b: float, cuts: Tensor = cuts) -> float:
            return -float((_monomials(log_a, log_b, cuts) @ cuts).min())

        def best(log_b: float) -> float:
            return _minimize_convex(lambda x: excess(x, log_b), *of_a)

        log_b = _minimize_convex(lambda x: excess(best(x), x), *of_b)
        log_a = best(log_b)
        weights = _monomials(log_a, log_b, terms)
        negligible = _ROUNDING * float(weights.abs() @ sizes)
        if excess(log_a, log_b) >= -negligible:
            return math.nan
        matrix, identity = torch.tensordot(weights, terms, 1), torch.eye(stiff.shape[-1]).to(stiff)
        lacking = torch.linalg.cholesky_ex(matrix - negligible * identity).info > 0
        if not bool(lacking.any()):
            a, b = math.exp(log_a), math.exp(log_b)
            root = torch.linalg.cholesky(torch.kron(stiff.new_tensor([[a, b], [b, 1.0]]), identity)).mT
            rows = ErrorDynamics(stiff[:, 0], torch.diag_embed(stiff), damp, identity[None])
            rate = -Function(root).largest(rows)
            return rate * frequency if rate > 0.0 else math.nan
        vectors = torch.linalg.eigh(matrix[lacking]).eigenvectors[..., :1]
        cuts = torch.cat([cuts, (vectors * (terms[:, lacking] @ vectors)).sum(-2).flatten(1)], dim=1)
    return math.nan


def _schur_terms(stiff: Float[Tensor, "n d"], damp: Float[Tensor, "n d d"]) -> Float[Tensor, "6 n d d"]:
    """Coefficients of T in the Notes, of its monomials a, b, b^2, 1, a b, a^2."""
    identity, lag = torch.eye(stiff.shape[-1]).to(stiff).expand_as(damp), damp / stiff[:, None, :]
    of_square = -4.0 * identity - symmetrize(lag @ damp)
    one, square = -torch.diag_embed(stiff), -torch.diag_embed(1.0 / stiff)
    return torch.stack([2.0 * identity, 2.0 * damp, of_square, one, lag + lag.mT, square])


def _monomials(log_a: float, log_b: float, like: Tensor) -> Tensor:
    a, b = math.exp(log_a), math.exp(log_b)
    return like.new_tensor([a, b, b * b, 1.0, a * b, a * a])


def _minimize_convex(function: Callable[[float], float], low: float, high: float) -> float:
    """Minimizer of a convex function of one variable by golden section, including the ends."""
    first, last = low, high
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    for _ in range(_N_GOLDEN):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            at_left = function(left := high - _GOLDEN * (high - low))
        else:
            low, left, at_left = left, right, at_right
            at_right = function(right := low + _GOLDEN * (high - low))
    return min((first, last, left, right), key=function)
