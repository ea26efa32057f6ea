"""Functions of the state that fall: whatever the schedule does, or along this very one."""

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.simulation.filters import lyapunov_matrix
from torch_pbd.control.stability.report import GROWTH_ROUNDING
from torch_pbd.linalg import spectral_map, symmetrize

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# Of the summands of the matrix whose smallest eigenvalue must be positive: a margin over rounding, 1e-13 of them.
_ROUNDING = 1e-10
# Of cuts; where K and D commute one is enough, and three have been the most that was needed.
_ROUNDS = 8
# Intervals among which a maximum over all is looked for at a time: more change nothing, fewer are asked more often.
_N_WORST = 32


def has_common_function(stiffness: Float[Tensor, "n d d"], damping: Float[Tensor, "n d d"]) -> bool:
    """Whether one quadratic function of the state falls under each of the gains, for a mass of 1.

    It then falls exponentially under any sequence of these pairs (K, D), turned in any way, and of blends of them, each
    held for any time or changing continuously.

    Notes
    -----
    ``V = a w^2 |y|^2 + 2 b w y'v + |v|^2`` does not depend on axes. With K in units of ``w^2`` and D in those of w,
    ``-dV/dt / w`` is the quadratic form of ``[[2 b K, K + b D - a], [K + b D - a, 2 D - 2 b]]`` in (w y, v), linear
    in (K, D): what holds for the pairs holds for their blends. It is positive for b > 0 if and only if
    ``T = 4 b (D - b) - (K + b D - a) K^-1 (K + b D - a)`` is, its Schur complement times 2 b; V itself then is,
    because the motion under constant gains dies out (Lyapunov). T is concave in (a, b), so the smallest of all
    eigenvalues is too, and it is maximized by cuts: ``z'T z`` of the eigenvectors z found so far is an upper bound.
    The first are those of K.
    """
    values, axes = torch.linalg.eigh(stiffness)
    frequency = (values.min().sqrt() * values.max().sqrt()).sqrt()
    stiff, damp = stiffness / frequency**2, damping / frequency
    compliance = (axes * (frequency**2 / values).unsqueeze(-2)) @ axes.mT
    lag, identity = damp @ compliance, torch.eye(stiff.shape[-1]).to(stiff).expand_as(stiff)
    terms = torch.stack(  # T by its monomials a, b, b^2, 1, a b, a^2
        [2.0 * identity, 2.0 * damp, -4.0 * identity - lag @ damp, -stiff, lag + lag.mT, -symmetrize(compliance)]
    )
    least = float(torch.linalg.eigvalsh(damp)[:, 0].min())
    if least <= 0.0 or not bool(torch.isfinite(terms).all()):
        return False
    # Where T is positive b is below every D, and a about between the smallest K and the largest K + b D. They are
    # searched by their logarithms, which stiffnesses of many powers of ten need, and which moves no maximum.
    largest = stiff.shape[-1] * float(stiff.abs().max() + least * damp.abs().max())
    of_a = math.log(1e-3 * float(values.min()) / float(frequency) ** 2), math.log(largest)
    of_b = math.log(1e-6 * least), math.log(least)
    cuts = _along(terms, axes)
    for _ in range(_ROUNDS):

        def excess(log_a: float, log_b: float, cuts: Tensor = cuts) -> float:
            return -float((_monomials(log_a, log_b, cuts) @ cuts).min())

        def best(log_b: float) -> float:
            return minimize_convex(lambda log_a: excess(log_a, log_b), *of_a, n_steps=32)

        log_b = minimize_convex(lambda log_b: excess(best(log_b), log_b), *of_b, n_steps=32)
        weights = _monomials(best(log_b), log_b, terms)
        negligible = _ROUNDING * float(weights.abs() @ terms.abs().amax((1, 2, 3)))
        if excess(best(log_b), log_b) >= -negligible:
            return False
        eigenvalues, vectors = torch.linalg.eigh(symmetrize(torch.tensordot(weights, terms, 1)))
        if float(eigenvalues.min()) > negligible:
            return True
        cuts = torch.cat([cuts, _along(terms, vectors[..., :1])], dim=1)
    return False


def _monomials(log_a: float, log_b: float, like: Tensor) -> Tensor:
    a, b = math.exp(log_a), math.exp(log_b)
    return torch.tensor([a, b, b * b, 1.0, a * b, a * a]).to(like)


def _along(terms: Float[Tensor, "k n d d"], vectors: Float[Tensor, "n d m"]) -> Float[Tensor, "k nm"]:
    return (vectors * (terms @ vectors)).sum(-2).flatten(1)


class Knots:
    """Gains (n, d, d), linear between times (n,), and what Kronander and Billard ask of them.

    Their conditions, ``K' + alpha D' <= 2 alpha K`` and ``alpha M <= D``, are linear in time where K and D are, so that
    holding at both ends of every interval is holding throughout; and convex in alpha.
    """

    def __init__(self, time: Tensor, stiffness: Tensor, damping: Tensor, mass: Tensor) -> None:
        step = time.diff()[:, None, None]
        inverse = torch.linalg.inv(torch.linalg.cholesky(mass))
        self.alpha_max = float(torch.linalg.eigvalsh(symmetrize(inverse @ damping @ inverse.mT)).min())
        self.stiffness = torch.stack([stiffness[:-1], stiffness[1:]])  # at both ends of every interval
        self.stiffness_rate, self.damping_rate = stiffness.diff(dim=0) / step, damping.diff(dim=0) / step

    def certificate(self) -> tuple[float, float, int]:
        """Alpha with the largest margin, that margin, and the interval where it is smallest."""

        def excess(alpha: float, rows: Any = slice(None)) -> Tensor:
            matrix = self.stiffness_rate[rows] + alpha * (self.damping_rate[rows] - 2.0 * self.stiffness[:, rows])
            return torch.linalg.eigvalsh(matrix)[..., -1].amax(0)

        if self.alpha_max <= 0.0:  # no damping somewhere: no alpha will do
            values = excess(0.0)
            return 0.0, min(-float(values.max()), -math.ulp(0.0)), int(values.argmax())
        alpha, values = _minimize_largest(excess, 1e-9 * self.alpha_max, self.alpha_max)
        return alpha, -float(values.max()), int(values.argmax())

    def max_speed(self) -> float:
        """Largest factor on the rates for which some alpha has no negative margin."""
        if self.alpha_max <= 0.0:
            return 0.0
        root = spectral_map(self.stiffness, torch.rsqrt)

        # The speed is at most one over the largest eigenvalue of K^-1/2 (K' / alpha + D') K^-1/2 / 2.
        def needed(log_inverse_alpha: float, rows: Any = slice(None)) -> Tensor:
            rate = math.exp(log_inverse_alpha) * self.stiffness_rate[rows] + self.damping_rate[rows]
            return 0.5 * torch.linalg.eigvalsh(symmetrize(root[:, rows] @ rate @ root[:, rows]))[..., -1].amax(0)

        # By its logarithm, of which it still falls and then rises: where K falls and D rises alpha must be small.
        slowest = -math.log(self.alpha_max)
        best = float(_minimize_largest(needed, slowest, slowest + math.log(1e9))[1].max())
        return 1.0 / best if best > 1e-12 else math.inf


def held_growth(maps: Tensor, stiffness: Tensor, damping: Tensor, mass: Tensor, alpha: float) -> float:
    """Largest eigenvalue of ``A' P_next A`` relative to P: A the exact map of an interval with its gains held.

    Of this alpha, or, where that grows, of a half or a quarter: at the largest some velocity does not damp V.
    """
    least = math.nan
    for each in (alpha, alpha / 2.0, alpha / 4.0) if alpha > 0.0 else ():
        function = lyapunov_matrix(stiffness, damping, mass, each)
        inverse = torch.linalg.inv(torch.linalg.cholesky(function[:-1]))
        grown = inverse @ maps.mT @ function[1:] @ maps @ inverse.mT
        growth = float(torch.linalg.eigvalsh(symmetrize(grown)).max())
        least = growth if math.isnan(least) else min(least, growth)
        if least <= 1.0 + GROWTH_ROUNDING:
            break
    return least


def _minimize_largest(function: Callable[..., Tensor], low: float, high: float) -> tuple[float, Tensor]:
    """Where the largest of many convex functions of one variable is smallest, and the values of all of them there.

    ``function(x, rows)`` has some of them. Most are never the largest: the search is among those that are so at an end
    and at the minima of the ones that were, until these are the largest of all.
    """
    found, values, rows = low, function(high), torch.empty(0, dtype=torch.long)
    while not len(rows) or values.max() > values[rows].max():
        rows = torch.cat([rows, values.topk(min(_N_WORST, len(values))).indices]).unique()
        found = minimize_convex(lambda x, rows=rows: float(function(x, rows).max()), low, high)
        values = function(found)
    return found, values


def minimize_convex(function: Callable[[float], float], low: float, high: float, n_steps: int = 45) -> float:
    """Where a convex function of one variable is smallest, by golden section; the ends are tried too."""
    first, last = low, high
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    for _ in range(n_steps):
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = function(right)
    return min((first, last, left, right), key=function)
