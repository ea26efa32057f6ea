"""Bringing demonstrations onto one grid: interpolation, phase, dynamic time warping."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd.arguments import as_floats
from torch_pbd.memory import require_much

Floats = NDArray[np.float64]


def interpolate(times: Floats, positions: Floats, query: Floats) -> Floats:
    """Positions at other times, linearly between the samples.

    Parameters
    ----------
    times : ndarray of shape (n,)
        Strictly increasing.
    positions : ndarray of shape (n, d)
    query : ndarray of shape (m,)
        Times within the range of ``times``; outside it the end point is held.

    Returns
    -------
    ndarray of shape (m, d)
    """
    return np.column_stack([np.interp(query, times, column) for column in positions.T])


def unit_phases(times: Sequence[Floats]) -> list[Floats]:
    """Time of each demonstration mapped affinely onto 0..1.

    Grids that differ only by offset and duration get the same phases to the last bit: rounding (1e-9 of the
    duration, or the resolution of large time stamps where that is coarser) would otherwise hide from an
    estimator that the demonstrations are aligned.

    Parameters
    ----------
    times : sequence of K ndarrays of shape (T_k,)
        Strictly increasing.

    Returns
    -------
    list of K ndarrays of shape (T_k,)
        From exactly 0 to exactly 1.
    """
    grids: dict[int, Floats] = {}
    phases = []
    for time in times:
        duration = time[-1] - time[0]
        phase = (time - time[0]) / duration
        grid = grids.setdefault(len(time), phase)
        rounding = max(1e-9, 4.0 * np.spacing(np.abs(time[[0, -1]]).max()) / duration)
        phases.append(grid if np.abs(phase - grid).max() <= rounding else phase)
    return phases


def dtw_path(a: ArrayLike, b: ArrayLike) -> NDArray[np.intp]:
    """Pairs of samples that dynamic time warping matches between two curves.

    The path minimizes the sum of squared distances over its pairs; each step advances one of the curves or
    both by one sample, and of equally good steps the one that advances both is taken.

    Parameters
    ----------
    a, b : array_like of shape (n, d) and (m, d)
        In the same units; n and m may differ.

    Returns
    -------
    ndarray of shape (p, 2)
        Indices into ``a`` and ``b``, from (0, 0) to (n - 1, m - 1), never decreasing; p < n + m.

    Raises
    ------
    ValueError
        If a curve is not 2-D, is empty, or the curves have different numbers of outputs.

    References
    ----------
    H. Sakoe, S. Chiba, "Dynamic programming algorithm optimization for spoken word recognition", IEEE
    Transactions on Acoustics, Speech, and Signal Processing 26, 1978.
    """
    first, second = as_floats(a, "a"), as_floats(b, "b")
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1]:
        raise ValueError(
            "dtw_path compares curves of shape (n, d) and (m, d) with the same d; got "
            f"{first.shape} and {second.shape}."
        )
    if not first.size or not second.size:
        raise ValueError(f"dtw_path needs at least one sample in each curve; got {first.shape}, {second.shape}.")
    for name, curve in (("a", first), ("b", second)):
        if not np.isfinite(curve).all():
            raise ValueError(f"{name} has a value that is not finite: drop or fill in such samples first.")
    return _backtrack(_accumulated_cost(first, second))


def dtw_warps(curves: Floats) -> Floats:
    """Phase of each curve as a function of a phase common to all of them.

    Every curve is matched with one of them, the one with the least total distance to the others at equal
    phase (the medoid); where several of its samples match one sample of the medoid their mean counts, which
    makes the match a monotone map. The common phase is the mean of these maps, so that the result has the
    mean timing of the demonstrations, not the timing of the medoid: the warps average to the identity in the
    sense that w_k = h_k(h^-1(s)) with h the mean of the h_k.

    Parameters
    ----------
    curves : ndarray of shape (K, n, d)
        On one evenly spaced grid of phases. Distances are Euclidean over the outputs as they are given.

    Returns
    -------
    ndarray of shape (K, n)
        Never decreasing, from exactly 0 to exactly 1.
    """
    flat = curves.reshape(len(curves), -1)
    medoid = int(np.argmin([np.linalg.norm(flat - curve, axis=1).sum() for curve in flat]))
    grid = np.linspace(0.0, 1.0, curves.shape[1])
    matches = [
        grid if k == medoid else _monotone_match(dtw_path(curves[medoid], curve)) for k, curve in enumerate(curves)
    ]
    common = np.mean(matches, axis=0)  # increases strictly, since the medoid's own match does
    return np.stack([np.interp(grid, common, match) for match in matches])


def _monotone_match(path: NDArray[np.intp]) -> Floats:
    """Phase of the second curve at each sample of the first, ends kept."""
    n_matched = np.bincount(path[:, 0])
    match = np.bincount(path[:, 0], weights=path[:, 1]) / n_matched / path[-1, 1]
    match[[0, -1]] = 0.0, 1.0
    return match


def _accumulated_cost(a: Floats, b: Floats) -> Floats:
    """Least cost (n + 1, m + 1) of a path to each pair; row and column 0 are the border."""
    n, m = len(a), len(b)
    require_much(24.0 * n * m, what=f"dynamic time warping of {n} by {m} samples", remedy="Take fewer, by n.")
    cost = np.zeros((n, m))
    for column_a, column_b in zip(a.T, b.T, strict=True):
        cost += np.subtract.outer(column_a, column_b) ** 2
    total = np.full((n + 1, m + 1), np.inf)
    total[0, 0] = 0.0
    for diagonal in range(n + m - 1):  # pairs with i + j = diagonal depend on earlier diagonals only
        i = np.arange(max(0, diagonal - m + 1), min(n, diagonal + 1))
        j = diagonal - i
        before = np.minimum(total[i, j], np.minimum(total[i, j + 1], total[i + 1, j]))
        total[i + 1, j + 1] = cost[i, j] + before
    return total


def _backtrack(total: Floats) -> NDArray[np.intp]:
    i, j = total.shape[0] - 1, total.shape[1] - 1
    path = [(i, j)]
    while (i, j) != (1, 1):
        steps = [(i - 1, j - 1), (i - 1, j), (i, j - 1)]
        i, j = min(steps, key=lambda step: total[step])  # the border is infinite but for its corner
        path.append((i, j))
    return np.array(path[::-1], dtype=np.intp) - 1
