"""Alignment of demonstrations on one grid: interpolation, phase, dynamic time warping."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torch_pbd.checks import Floats
from torch_pbd.data.units import exact, nanoseconds_hint
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_much

TIMING_REMOVED = (
    "The demonstrations were aligned by dynamic time warping, which took timing out that every new one has: on real "
    "ones that cost 3.7 nats a step, and 95 % ellipses held 42 to 65 %. Learn from .align('phase'), or without it."
)


def interpolate(times: Floats, positions: Floats, query: Floats) -> Floats:
    """Positions (m, d) at query times (m,), linear between samples and constant beyond them."""
    return np.column_stack([np.interp(query, times, column) for column in positions.T])


def unit_phases(times: Sequence[Floats]) -> list[Floats]:
    """Time of each demonstration mapped affinely onto 0..1, exactly 0 and 1 at its ends."""
    return times_from_start(times, [time[-1] - time[0] for time in times])


def times_from_start(times: Sequence[Floats], units: Sequence[float] | None = None) -> list[Floats]:
    """Times of each demonstration since its start, divided by its own unit if ``units`` are given.

    Grids that differ only by rounding become one to the last bit: an estimator would otherwise not see that the
    demonstrations are aligned.
    """
    grids: dict[int, Floats] = {}
    shared = []
    for time, unit in zip(times, units or [1.0] * len(times), strict=True):
        own = (time - time[0]) / unit
        grid = grids.setdefault(len(time), own)
        # Rounding is a billionth of the duration, or the resolution of large stamps: each difference has two errors,
        # and two grids are compared.
        rounding = max(1e-9 * own[-1], 4.0 * np.spacing(np.abs(time[[0, -1]]).max()) / unit)
        shared.append(grid if np.abs(own - grid).max() <= rounding else own)
    return shared


def check_overlap(times: Sequence[Floats], time_unit: str) -> None:
    """Check that recordings share half of their median duration; otherwise most samples would have no match."""
    starts, ends = (np.array([time[i] for time in times]) for i in (0, -1))
    last, first = starts.argmax(), ends.argmin()
    # Times may lie so far apart that their difference is infinite, which is no overlap either.
    with np.errstate(over="ignore"):
        common, duration = max(ends[first] - starts[last], 0.0), np.median(ends - starts)
    if common < 0.5 * duration:
        raise InvalidParameterError(
            f"the demonstrations have {common:.3g} of a median duration of {duration:.3g} {time_unit} in common: "
            f"number {last} starts last, at {exact(starts[last])}, {first} ends first, at {exact(ends[first])}. Count "
            f"from each start, .from_start() or from_start=True, or .align('phase').{nanoseconds_hint(starts)}"
        )


def dtw_path(a: Floats, b: Floats) -> NDArray[np.intp]:
    """Pairs (p, 2) of samples matched by dynamic time warping between curves (n, d) and (m, d) with fixed ends.

    The path minimizes the sum of squared distances over its pairs; each step advances one of the curves or
    both by one sample, and of equally good steps the one that advances both is taken (H. Sakoe, S. Chiba, IEEE
    Transactions on Acoustics, Speech, and Signal Processing 26, 1978).
    """
    n, m = len(a), len(b)
    require_much(24.0 * n * m, what=f"dynamic time warping of {n} by {m} samples", remedy="Take fewer, by n.")
    cost = np.zeros((n, m))  # squared distances; scipy's cdist takes a second to import
    for column_a, column_b in zip(a.T, b.T, strict=True):
        cost += np.subtract.outer(column_a, column_b) ** 2
    # D(i, j) = c(i, j) + min(D(i-1, j-1), D(i-1, j), D(i, j-1)), with a border of infinities before the first samples:
    # pairs with one i + j depend on earlier diagonals only, so that each diagonal is one operation.
    total = np.full((n + 1, m + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(n + m - 1):
        i = np.arange(max(0, diagonal - m + 1), min(n, diagonal + 1))
        j = diagonal - i
        before = np.minimum(total[i, j], np.minimum(total[i, j + 1], total[i + 1, j]))
        total[i + 1, j + 1] = cost[i, j] + before
    path = [(n, m)]
    while path[-1] != (1, 1):
        row, column = path[-1]
        path.append(min((row - 1, column - 1), (row - 1, column), (row, column - 1), key=lambda step: total[step]))
    return np.array(path[::-1], dtype=np.intp) - 1


def dtw_warps(curves: Floats) -> Floats:
    """Phase (K, n) of each of the curves (K, n, d) as a function of a phase common to all, from exactly 0 to exactly 1.

    Every curve is matched with the medoid, the one with the least total distance to the others at equal phase; where
    several of its samples match one of the medoid, their mean makes the match a monotone map h_k. The common phase is
    the mean h of these maps, so that the result has the mean timing of the demonstrations, not that of the medoid: the
    warps w_k = h_k(h^-1(s)) average to the identity.
    """
    flat = curves.reshape(len(curves), -1)
    medoid = int(np.argmin([np.linalg.norm(flat - curve, axis=1).sum() for curve in flat]))
    grid = np.linspace(0.0, 1.0, curves.shape[1])
    matches = np.tile(grid, (len(curves), 1))
    for k, curve in enumerate(curves):
        if k != medoid:
            path = dtw_path(curves[medoid], curve)
            matches[k] = np.bincount(path[:, 0], weights=path[:, 1]) / np.bincount(path[:, 0]) / path[-1, 1]
            matches[k, [0, -1]] = 0.0, 1.0
    common = matches.mean(axis=0)  # increases strictly, since the medoid's own match does
    return np.stack([np.interp(grid, common, match) for match in matches])


def comparable_scale(curves: Floats, units: Sequence[str]) -> Floats:
    """Divisor (d,) of each output of curves (K, n, d) that makes distances over all outputs meaningful.

    Outputs of the same unit share one divisor, so that the result does not depend on their axes.
    """
    if len(set(units)) == 1:
        return np.ones(curves.shape[2])
    same = np.equal.outer(np.array(units), np.array(units))
    scale = np.sqrt(same @ curves.var(axis=(0, 1)) / same.sum(axis=1))
    # An output that is constant up to rounding has no information on timing: 1e-12 is the rounding of sums of
    # thousands of samples in float64.
    rounding = 1e-12 * np.abs(curves).max(axis=(0, 1))
    return np.where(scale > rounding, scale, np.inf)
