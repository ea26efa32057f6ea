"""Kronander and Billard's Lyapunov function along a schedule."""

import math
from collections.abc import Callable
from functools import partial
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.stability.dynamics import ErrorDynamics
from torch_pbd.control.stability.report import GROWTH_ROUNDING
from torch_pbd.linalg import block_matrix, evenly, least_eigenvalue, rows_below, smallest_eigenvalues, symmetrize

# Intervals among which a minimum over all is searched at a time: more change nothing, fewer need more rounds.
_N_WORST = 16
# Relative tolerance by which an interval may be below the smallest eigenvalue found among some of them.
_SLACK = 1e-10
# Rise of the stiffness, relative to it and per unit of speed, that counts as none.
_NO_RISE = 1e-12
_LEAST = 1e-9  # smallest alpha that is tried, relative to the largest
_GRID, _N_GRIDS = 32, 9  # points of which a logarithm is looked for to 1e-9, and of how many grids
_MAX_CUTS, _CLOSE = 30, 1e-8  # rounds, and what is left of the relative difference between the bound and the value

Pencils = Callable[[float, Tensor, float, float], Tensor]
"""Pencils (c, m, s, s), at c points of each of m intervals, that are linear in a parameter."""


class Knots:
    """Rows of a schedule, linear in between, with Kronander and Billard's Lyapunov function.

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
        self._gains = [_at_points(each, transport is not None) for each in gains]
        rates = [each.diff(dim=0) / step if len(each) > 1 else torch.zeros_like(each) for each in gains]
        stiffness_rate, damping_rate, mass_rate = (each[None] for each in rates)
        coupling_rate = mass_rate
        if transport is not None:
            stiff, damp, massive = (_turned(each, transport) for each in gains)
            stiffness_rate, damping_rate = stiffness_rate + (stiff + stiff.mT), damping_rate + (damp + damp.mT)
            coupling_rate = mass_rate + massive.mT  # W' = -W
        self._rates = [stiffness_rate, damping_rate, mass_rate, coupling_rate]
        # Largest alpha of a schedule that stands still, 1/s.
        damping = dynamics.modes[2]
        self._fastest = float((damping if damping.ndim == 2 else torch.linalg.eigvalsh(damping)).min())

    def certificate(self) -> tuple[float, float, int]:
        """Alpha with the largest decay rate, that rate, and the interval where it is attained."""
        alpha_max, (_, damping, mass), mass_rate = self._fastest, self._gains, self._rates[2]
        if len(mass) > 1:
            damped = damping - 0.5 * mass_rate
            alpha = least_eigenvalue(lambda rows, q, p: q * damped[:, rows] + p * mass[:, rows], self._n_intervals)[0]
            alpha_max = min(alpha_max, alpha)

        def pencil(alpha: float, rows: Tensor, q: float, p: float) -> Tensor:
            return self.form(alpha, rows, q, q, p)

        if alpha_max <= 0.0:  # some velocity has no damping: no alpha will do, though V may fall
            values = smallest_eigenvalues(partial(pencil, 0.0), torch.arange(self._n_intervals)).amin(0)
            return 0.0, min(float(values.min()), -math.ulp(0.0)), int(values.argmin())
        return _maximize_smallest(pencil, _LEAST * alpha_max, alpha_max, self._n_intervals)

    def max_speed(self) -> float:
        """Largest replay speed for which some alpha has a non-negative decay rate."""
        if self._fastest <= 0.0:
            return 0.0

        # The speed is at most one over the largest eigenvalue of what moving adds to -Q, relative to Q held. If nothing
        # but K and D moves, that is of the deviation alone; it is linear in 1 / alpha then, and in alpha otherwise.
        def of_deviation(lag: float, rows: Tensor, q: float, p: float) -> Tensor:
            rise = lag * self._rates[0][:, rows] + self._rates[1][:, rows]
            return p * self._gains[0][:, rows] - 0.5 * q * rise

        def of_state(alpha: float, rows: Tensor, q: float, p: float) -> Tensor:
            return self.form(alpha, rows, p, q, 0.0)

        if self._is_plain:
            low, high = 1.0 / self._fastest, 1.0 / (_LEAST * self._fastest)
            least = _maximize_smallest(of_deviation, low, high, self._n_intervals, _NO_RISE)[1]
        else:  # at the largest alpha Q of a schedule that stands still is singular
            high = (1.0 - 1e-6) * self._fastest
            least = _maximize_smallest(of_state, _LEAST * high, high, self._n_intervals, _NO_RISE)[1]
        return -1.0 / least if least < -_NO_RISE else math.inf

    def form(self, alpha: float, rows: Tensor, still: float, moving: float, function: float) -> Tensor:
        """So much of Q of a schedule that stands still, of what moving adds to it, and of P; at points of intervals."""

        def at(points: Tensor) -> Tensor:
            return points if points.shape[1] == 1 else points[:, rows]

        stiffness, damping, mass = map(at, self._gains)
        stiffness_rate, damping_rate, mass_rate, coupling_rate = (0.5 * moving * at(each) for each in self._rates)
        first = (still * alpha + function) * stiffness + function * alpha * damping
        last = still * damping + (function - still * alpha) * mass - mass_rate
        cross = alpha * (function * mass - coupling_rate)
        return block_matrix(first - stiffness_rate - alpha * damping_rate, cross, cross.mT, last)


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


def _maximize_smallest(
    pencil: Pencils, low: float, high: float, n_intervals: int, floor: float = 0.0
) -> tuple[float, float, int]:
    """Where the smallest of all eigenvalues of Q relative to P is largest, that eigenvalue, and its interval.

    ``z'Q z / z'P z`` of any vector z is no less than the smallest eigenvalue, and a quotient of two linear functions of
    the parameter: ``cuts`` has both at the two ends. Where the smallest of these bounds is largest, the vectors of what
    is below it give more, of some intervals; and once none of these is, the lowest of all others join, if they are
    below the smallest eigenvalue found.
    """
    joining = rows = evenly(n_intervals, _N_WORST)
    parts: list[Tensor] = []
    cuts, best = torch.empty(4, 0).double(), math.sqrt(low * high)
    while True:
        ends = product((low, high), ((1.0, 0.0), (0.0, 1.0)))
        forms = [pencil(end, joining, *which).flatten(0, 1) for end, which in ends]
        parts.append(torch.stack(forms).unflatten(0, (2, 2)))
        best, cuts = _maximize_bound(torch.cat(parts, dim=2), low, high, best, cuts)
        values = smallest_eigenvalues(partial(pencil, best), rows).amin(0)
        least = float(values.min())
        below = rows_below(partial(pencil, best), least - max(_SLACK * abs(least), floor), n_intervals)
        below = below[~torch.isin(below, rows)]
        if not len(below):
            return best, least, int(rows[values.argmin()])
        tried = below[evenly(len(below), 8 * _N_WORST)]
        joining = tried[smallest_eigenvalues(partial(pencil, best), tried).amin(0).argsort()[:_N_WORST]]
        rows = torch.cat([rows, joining])


def _maximize_bound(
    ends: Float[Tensor, "2 2 k s s"], low: float, high: float, best: float, cuts: Float[Tensor, "4 n"]
) -> tuple[float, Float[Tensor, "4 m"]]:
    """Where the smallest bound is largest, and no matrix between those at both ends has an eigenvalue below it."""
    lacking = torch.ones(ends.shape[2], dtype=torch.bool)
    for _ in range(_MAX_CUTS):
        of_lacking = ends[:, :, lacking]
        matrix, relative_to = torch.lerp(of_lacking[0], of_lacking[1], (best - low) / (high - low))
        inverse = torch.linalg.inv(torch.linalg.cholesky(relative_to))
        vector = inverse.mT @ torch.linalg.eigh(symmetrize(inverse @ matrix @ inverse.mT)).eigenvectors[..., :1]
        forms = vector.mT @ of_lacking @ vector
        cuts = torch.cat([cuts, forms.reshape(4, -1)], dim=1)
        best, bound = _largest_bound(cuts, low, high)
        matrix, relative_to = torch.lerp(ends[0], ends[1], (best - low) / (high - low))
        lacking = torch.linalg.cholesky_ex(matrix - (bound - _CLOSE * abs(bound)) * relative_to).info > 0
        if not bool(lacking.any()):
            break
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


def held_growth(dynamics: ErrorDynamics, maps: Float[Tensor, "k s s"], alpha: float) -> float:
    """Largest eigenvalue of ``A' P_next A`` relative to P, if above 1: A the map of an interval with its gains held.

    It is for this alpha or, where that grows, a half or a quarter. ``maps`` are from ``dynamics.tick_maps``, in whose
    coordinates ``e'(K + alpha D)e + 2 alpha e'Mv + v'Mv`` is a form of the modes.
    """
    squared, _, damping = dynamics.modes
    lag, identity = squared.rsqrt(), torch.eye(squared.shape[-1]).to(squared)
    damping = torch.diag_embed(damping) if damping.ndim == 2 else damping
    delayed, across = lag[:, :, None] * damping * lag[:, None, :], torch.diag_embed(lag)
    growths = []
    for each in (alpha, alpha / 2.0, alpha / 4.0):
        function = block_matrix(identity + each * delayed, each * across, each * across, identity)

        def pencil(rows: Tensor, q: float, p: float, function: Tensor = function) -> Tensor:
            return p * function[rows] - q * maps[rows].mT @ function[rows + 1] @ maps[rows]

        grown = rows_below(pencil, -1.0 - GROWTH_ROUNDING, len(maps))
        growths.append(-float(smallest_eigenvalues(pencil, grown).min()) if len(grown) else 1.0)
        if growths[-1] <= 1.0 + GROWTH_ROUNDING:
            break
    return min(growths)
