"""Kronander and Billard's function of the state along a schedule, and what it needs."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.control.simulation.filters import lyapunov_matrix
from torch_pbd.control.stability.dynamics import ErrorDynamics
from torch_pbd.control.stability.report import GROWTH_ROUNDING
from torch_pbd.linalg import symmetrize

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
# Intervals among which a minimum over all is looked for at a time: more change nothing, fewer are asked more often.
_N_WORST = 16
# Relative: no interval is below the smallest eigenvalue found among some of them by more.
_SLACK = 1e-10
# s: a rise of the stiffness, relative to it and per unit of speed, that is none.
_NO_RISE = 1e-12
_LEAST = 1e-9  # alpha that is tried, relative to the largest
_GRID, _N_GRIDS = 32, 7  # points of which a logarithm is looked for to 1e-8, and of how many grids
_MAX_CUTS, _CLOSE = 30, 1e-6  # rounds, and what is left of the relative difference between the bound and the value
_AT_ONCE = 256  # intervals that are checked together, which bounds the memory

Pencil = Callable[[float, Tensor], tuple[Tensor, Tensor]]
"""Symmetric matrices Q and positive definite P (c, m, s, s), at c points of each of m intervals, by a parameter."""


class Knots:
    """Rows of a schedule, linear in between, and the function of Kronander and Billard along it.

    ``V = 1/2 v'Mv + alpha e'Mv + 1/2 e'(K + alpha D)e = 1/2 z'Pz`` of the state z = (e, v) changes by ``-z'Qz``,

        Q = [[alpha K - K*/2 - alpha D*/2, -alpha (M' - W M)/2], [., D - alpha M - M'/2]],

    where ``K* = K' + K W - W K`` is the change of K but for what turns with the desired motion, and D* alike. The
    rate is the smallest eigenvalue of Q relative to P: ``V^1/2`` falls by at least this rate, in 1/s, whatever the
    units of e.

    Notes
    -----
    For one alpha and rate, ``Q - rate P`` is linear in time within an interval where nothing is carried along: what is
    positive definite at both ends is so throughout. With W, linear in time too, it is quadratic: of
    ``(1 - s)^2 A + 2 s (1 - s) B + s^2 C``, A and C are those of the ends, and B has half the products of the gains of
    each end with the W of the other. What is positive definite for these three is so throughout.
    For one rate and speed it is linear in alpha: the alphas that serve are an interval.
    """

    def __init__(self, dynamics: ErrorDynamics) -> None:
        step, transport = dynamics.time.diff()[:, None, None], dynamics.transport
        self._n_intervals, self._is_plain = len(step), dynamics.is_plain
        gains = (dynamics.stiffness, dynamics.damping, dynamics.mass)
        self._stiffness, self._damping, self._mass = (_at_points(each, transport is not None) for each in gains)
        self._stiffness_rate, self._damping_rate, self._mass_rate = (
            (each.diff(dim=0) / step if len(each) > 1 else torch.zeros_like(each))[None] for each in gains
        )
        self._coupling_rate = self._mass_rate
        if transport is not None:
            stiff, damp, massive = (_turned(each, transport) for each in gains)
            self._stiffness_rate = self._stiffness_rate + (stiff + stiff.mT)
            self._damping_rate = self._damping_rate + (damp + damp.mT)
            self._coupling_rate = self._mass_rate + massive.mT  # W' = -W
        # Largest alpha of a schedule that stands still, 1/s.
        self._fastest = float(smallest_eigenvalues(dynamics.damping, dynamics.mass).min())

    def certificate(self) -> tuple[float, float, int]:
        """Alpha with the largest rate, that rate, and the interval where it is smallest."""
        alpha_max = self._fastest
        if len(self._mass) > 1:
            damped = self._damping - 0.5 * self._mass_rate
            alpha_max = min(alpha_max, float(smallest_eigenvalues(damped, self._mass).min()))

        def pencil(alpha: float, rows: Tensor) -> tuple[Tensor, Tensor]:
            held, moving = self.dissipation(alpha, rows)
            return held + moving, self.function(alpha, rows)

        if alpha_max <= 0.0:  # some velocity has no damping: no alpha will do, though V may fall
            values = smallest_eigenvalues(*pencil(0.0, torch.arange(self._n_intervals))).amin(0)
            return 0.0, min(float(values.min()), -math.ulp(0.0)), int(values.argmin())
        return _maximize_smallest(pencil, _LEAST * alpha_max, alpha_max, self._n_intervals)

    def max_speed(self) -> float:
        """Largest factor on the rates for which some alpha has no negative rate."""
        if self._fastest <= 0.0:
            return 0.0

        # The speed is at most one over the largest eigenvalue of what moving adds to -Q, relative to Q held. If nothing
        # but K and D moves, that is of the deviation alone; it is linear in 1 / alpha then, and in alpha otherwise.
        def of_deviation(lag: float, rows: Tensor) -> tuple[Tensor, Tensor]:
            rise = lag * self._stiffness_rate[:, rows] + self._damping_rate[:, rows]
            return (-0.5 * rise).expand(2, -1, -1, -1), self._stiffness[:, rows]

        def of_state(alpha: float, rows: Tensor) -> tuple[Tensor, Tensor]:
            return self.dissipation(alpha, rows)[::-1]

        if self._is_plain:
            least = _maximize_smallest(
                of_deviation, 1.0 / self._fastest, 1.0 / (_LEAST * self._fastest), self._n_intervals, _NO_RISE
            )[1]
        else:  # at the largest alpha Q of a schedule that stands still is singular
            high = (1.0 - 1e-6) * self._fastest
            least = _maximize_smallest(of_state, _LEAST * high, high, self._n_intervals, _NO_RISE)[1]
        return -1.0 / least if least < -_NO_RISE else math.inf

    def function(self, alpha: float, rows: Tensor) -> Tensor:
        """P at the points of some intervals."""
        stiffness, damping, mass = (_of(each, rows) for each in (self._stiffness, self._damping, self._mass))
        return lyapunov_matrix(stiffness, damping, mass, alpha)

    def dissipation(self, alpha: float, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Q of a schedule that stands still, and what moving adds to it."""
        stiffness, damping, mass = (_of(each, rows) for each in (self._stiffness, self._damping, self._mass))
        rates = (self._stiffness_rate, self._damping_rate, self._coupling_rate, self._mass_rate)
        stiffness_rate, damping_rate, coupling_rate, mass_rate = (_of(each, rows) for each in rates)
        of_deviation = (-0.5 * (stiffness_rate + alpha * damping_rate)).expand_as(stiffness)
        return (
            _blocks(alpha * stiffness, torch.zeros_like(stiffness), damping - alpha * mass),
            _blocks(of_deviation, -0.5 * alpha * coupling_rate, -0.5 * mass_rate),
        )


def _blocks(first: Tensor, cross: Tensor, last: Tensor) -> Tensor:
    """Matrices ``[[first, cross], [cross', last]]``."""
    first, cross, last = torch.broadcast_tensors(first, cross, last)
    return torch.cat([torch.cat([first, cross], dim=-1), torch.cat([cross.mT, last], dim=-1)], dim=-2)


def _at_points(matrix: Float[Tensor, "n d d"], is_turning: bool) -> Float[Tensor, "c k d d"]:
    """Matrices at both ends of every interval, and, where Q is quadratic, their mean."""
    if len(matrix) == 1:
        return matrix[None]
    ends = [matrix[:-1], matrix[1:]]
    return torch.stack([*ends, 0.5 * (ends[0] + ends[1])] if is_turning else ends)


def _turned(matrix: Float[Tensor, "m d d"], transport: Float[Tensor, "n d d"]) -> Float[Tensor, "3 k d d"]:
    """Products of matrices and transport at both ends of every interval, and the mean of those of the one and other."""
    first, last = (matrix[:-1], matrix[1:]) if len(matrix) > 1 else (matrix, matrix)
    mixed = 0.5 * (first @ transport[1:] + last @ transport[:-1])
    return torch.stack([first @ transport[:-1], last @ transport[1:], mixed])


def _of(points: Float[Tensor, "c k d d"], rows: Tensor) -> Float[Tensor, "c m d d"]:
    return points if points.shape[1] == 1 else points[:, rows]


def smallest_eigenvalues(matrix: Float[Tensor, "*b s s"], relative_to: Float[Tensor, "*p s s"]) -> Float[Tensor, "*b"]:
    """Smallest eigenvalues of symmetric matrices relative to positive definite ones."""
    factor = torch.linalg.cholesky(relative_to)
    half = torch.linalg.solve_triangular(factor, matrix, upper=False)
    whole = torch.linalg.solve_triangular(factor.mT, half, upper=True, left=False)
    return torch.linalg.eigvalsh(symmetrize(whole))[..., 0]


def _maximize_smallest(
    pencil: Pencil, low: float, high: float, n_intervals: int, floor: float = 0.0
) -> tuple[float, float, int]:
    """Where the smallest of all eigenvalues of Q relative to P is largest, that eigenvalue, and its interval.

    Most intervals never have it: the search is among some, and whether another is below, which a Cholesky factor tells
    sooner than eigenvalues do, is asked where it ended; the lowest of those join.
    """
    rows, cuts, best = evenly(n_intervals, _N_WORST), torch.empty(4, 0).double(), math.sqrt(low * high)
    while True:
        best, cuts = _maximize_by_cuts(pencil, low, high, rows, best, cuts)
        values = smallest_eigenvalues(*pencil(best, rows)).amin(0)
        least = float(values.min())
        below = _below(pencil, best, least - max(_SLACK * abs(least), floor), n_intervals)
        below = below[~torch.isin(below, rows)]
        if not len(below):
            return best, least, int(rows[values.argmin()])
        tried = below[evenly(len(below), 8 * _N_WORST)]
        lowest = smallest_eigenvalues(*pencil(best, tried)).amin(0).topk(min(_N_WORST, len(tried)), largest=False)
        rows = torch.cat([rows, tried[lowest.indices]])


def _maximize_by_cuts(
    pencil: Pencil, low: float, high: float, rows: Tensor, start: float, cuts: Float[Tensor, "4 n"]
) -> tuple[float, Float[Tensor, "4 m"]]:
    """Where the smallest eigenvalue of these intervals is largest, and the bounds that tell it.

    ``z'Q z / z'P z`` of any vector z is no less than the smallest eigenvalue, and a quotient of two linear functions of
    the parameter: ``cuts`` has both at the two ends. The vectors are those of the smallest eigenvalues where the
    smallest of the bounds was largest.
    """
    ends = [torch.stack(pencil(end, rows)) for end in (low, high)]
    best = start
    for _ in range(_MAX_CUTS):
        matrix, relative_to = pencil(best, rows)
        inverse = torch.linalg.inv(torch.linalg.cholesky(relative_to))
        values, vectors = torch.linalg.eigh(symmetrize(inverse @ matrix @ inverse.mT))
        vector = inverse.mT @ vectors[..., :1]
        of_ends = torch.stack([(vector.mT @ end @ vector).flatten(1) for end in ends]).flatten(0, 1)
        cuts = torch.cat([cuts, of_ends], dim=1)

        found, largest = _largest_bound(cuts, low, high)
        if largest - float(values[..., 0].min()) <= _CLOSE * abs(largest):
            break
        best = found
    return best, cuts


def _largest_bound(cuts: Float[Tensor, "4 n"], low: float, high: float) -> tuple[float, float]:
    """Where the smallest of the bounds is largest, on finer and finer grids of the logarithm, and that bound."""
    first, last = math.log(low), math.log(high)
    for _ in range(_N_GRIDS):
        grid = torch.linspace(first, last, _GRID, dtype=cuts.dtype)
        share = ((grid.exp() - low) / (high - low))[:, None, None]
        bounds = torch.lerp(cuts[:2], cuts[2:], share)
        lowest = (bounds[:, 0] / bounds[:, 1]).amin(-1)
        k = int(lowest.argmax())
        first, last = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, _GRID - 1)])
    return math.exp(float(grid[k])), float(lowest[k])


def _below(pencil: Pencil, parameter: float, value: float, n_intervals: int) -> Tensor:
    """Intervals with an eigenvalue below a value."""
    found = []
    for rows in torch.arange(n_intervals).split(_AT_ONCE):
        matrix, relative_to = pencil(parameter, rows)
        found.append(rows[(torch.linalg.cholesky_ex(matrix - value * relative_to).info > 0).any(0)])
    return torch.cat(found)


def evenly(n: int, most: int) -> Int64[Tensor, " m"]:
    """At most so many of n indices, the first and last among them."""
    return torch.linspace(0, n - 1, min(n, most)).round().long().unique()


def held_growth(dynamics: ErrorDynamics, maps: Float[Tensor, "k s s"], alpha: float) -> float:
    """Largest eigenvalue of ``A' P_next A`` relative to P, if above 1: A the map of an interval with its gains held.

    Of this alpha, or, where that grows, of a half or a quarter.
    """
    least = math.nan
    for each in (alpha, alpha / 2.0, alpha / 4.0) if alpha > 0.0 else ():
        function = lyapunov_matrix(dynamics.stiffness, dynamics.damping, dynamics.mass, each)
        growth = max(map(_growth, maps.split(_AT_ONCE), function[:-1].split(_AT_ONCE), function[1:].split(_AT_ONCE)))
        least = growth if math.isnan(least) else min(least, growth)
        if least <= 1.0 + GROWTH_ROUNDING:
            break
    return least


def _growth(maps: Tensor, before: Tensor, after: Tensor) -> float:
    carried, identity = maps.mT @ after @ maps, torch.eye(maps.shape[-1]).to(maps)
    inverse = torch.linalg.solve_triangular(torch.linalg.cholesky(before), identity, upper=False)
    relative = symmetrize(inverse @ carried @ inverse.mT)
    grown = torch.linalg.cholesky_ex((1.0 + GROWTH_ROUNDING) * identity - relative).info > 0
    return float(torch.linalg.eigvalsh(relative[grown]).max()) if bool(grown.any()) else 1.0


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
