"""One function of the state that falls whatever the schedule does, found or shown not to exist."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import symmetrize

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_ROUNDING = 1e-10  # of the summands of the matrix whose smallest eigenvalue must be positive
_ROUNDS = 8  # of cuts; where K and D commute one is enough, and three have been the most that was needed


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
