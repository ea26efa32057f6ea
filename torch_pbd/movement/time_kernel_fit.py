"""Fit of time kernels: length scales by likelihood alternating with nuggets by EM, then the kernel's share."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.movement.time_kernel import TimeKernel, smooth_correlation

# Candidate length scales in ranges of the time, from the spacing of fifty steps to a movement that bends once, and
# candidate nuggets shared by all steps.
_LENGTHS = torch.logspace(math.log10(0.02), 0.0, 14, dtype=torch.float64).tolist()
_NUGGETS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
_FINE_WEIGHTS = (0.03, 0.1, 0.3, 0.6)  # candidate shares of the tremor in the variance at a usual step
_RATIOS = (2.0, 4.0)  # candidate ratios of the slow length scale to the tremor's
_LEAST, _MOST, _FIRST = 1e-6, 1e3, 1e-2  # nuggets: smallest, largest, and where expectation maximization starts
_N_STEPS, _TOLERANCE = 40, 0.02  # expectation maximization: most iterations, and change of a logarithm that ends it
_SMOOTH = 1e-3  # largest nugget of a step that is distinguished from noise: such steps determine the length scale
_NEAR = 2.5  # factor around a length scale within which it is searched again once there are nuggets
_USUAL = 2.0  # factor around the median within which the size of a step's residuals is usual
_ROUNDS = 3  # alternations of nuggets and length scale, which depend on each other
_SHARES = (1.0, 0.9, 0.75, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05)  # candidate weights of the kernel in the correlation


class Scales(NamedTuple):
    """Length scales of the slow part and of the tremor, and the tremor's weight at a usual step, 0 without one."""

    slow: float
    fine: float
    weight: float


class Found(NamedTuple):
    """Likeliest scales and nugget, shared by all steps."""

    log_likelihood: float
    scales: Scales
    nugget: float


def fit_time_kernel(
    grid: Float[Tensor, " T"],
    residual: Float[Tensor, "K T d"],
    deviation: Float[Tensor, "T d"],
    kernels: Sequence[str],
    share: float | None,
) -> TimeKernel:
    """Time kernel of whitened residuals, NaN where a demonstration has no sample near, over times of range one.

    Each output's residuals, given the outputs before it, were divided by its ``deviation``. The likeliest of the
    ``kernels`` is taken, and for ``share`` None the share under which demonstrations left out in turn are likeliest.
    """
    outputs = [_unit_rms(part) for part in residual.split(1, dim=2)]
    usual = [_usual_steps(part) for part in outputs]
    found = {name: [_search(grid, *each, name) for each in zip(outputs, usual, strict=True)] for name in kernels}
    kernel = max(kernels, key=lambda name: sum(each.log_likelihood for each in found[name]))
    shares = _SHARES if share is None else (share,)
    tremor = deviation.median(0).values / deviation
    fitted = []
    for part, steps, size, single in zip(outputs, usual, tremor.mT, found[kernel], strict=True):
        # A tremor that makes the residuals of one output likelier need not do so jointly with those of the others.
        results = [_fit_output(grid, part, steps, size, kernel, single, is_sum) for is_sum in (False, True)]
        fitted.append(max(results, key=lambda result: _left_out(result, shares)[0]))
    stacked = {name: torch.cat([getattr(each, name) for each in fitted]) for name in ("scales", "fine", "nugget")}
    filled = torch.cat([each.residual for each in fitted], dim=2)
    whole = TimeKernel(kernel, grid, **stacked, residual=filled, share=grid.new_ones(()))
    whole.share.fill_(_left_out(whole, shares)[1])
    return whole


def _usual_steps(residual: Float[Tensor, "K T 1"]) -> Bool[Tensor, " T"]:
    """Steps at which residuals are of about the median size."""
    sizes = residual.square().nanmean((0, 2)).sqrt()
    return (sizes > sizes.nanmedian() / _USUAL) & (sizes < sizes.nanmedian() * _USUAL)


def _fit_output(
    grid: Tensor,
    residual: Float[Tensor, "K T 1"],
    usual: Bool[Tensor, " T"],
    tremor: Float[Tensor, " T"],
    kernel: str,
    single: Found,
    is_sum: bool,
) -> TimeKernel:
    """Scales and nuggets of one output in alternation, starting from the likeliest scales of the usual steps."""
    found = _with_tremor(grid, residual, usual, kernel, single, tremor) if is_sum else single
    unit = _candidates(grid, tremor, [found.scales], kernel)[0]
    nugget = _step_nuggets(unit, residual, _LEAST)
    for _ in range(_ROUNDS):
        smooth = nugget <= _SMOOTH
        steps = smooth if 2 * smooth.sum() >= len(grid) else nugget <= nugget.median()
        before, single = found, _search(grid, residual, steps, kernel, single.scales.slow)
        found = _with_tremor(grid, residual, steps, kernel, single, tremor) if is_sum else single
        if found[1:] == before[1:]:
            break
        unit = _candidates(grid, tremor, [found.scales], kernel)[0]
        nugget = _step_nuggets(unit, residual, min(found.nugget, 0.1 * _SMOOTH))
    filled = residual.clone()
    for k, own in enumerate(residual):  # the kernel's expectation where there were no samples
        seen = ~own.isnan().any(1)
        root = safe_cholesky(unit[seen][:, seen] + torch.diag(nugget[seen]), name="the time kernel")
        filled[k, ~seen] = unit[~seen][:, seen] @ torch.cholesky_solve(own[seen], root)
    scales, fine = _tensors(tremor, [found.scales])
    return TimeKernel(kernel, grid, scales, fine, nugget[None], filled, grid.new_ones(()))


def _tensors(
    tremor: Float[Tensor, " n"], scales: Sequence[Scales]
) -> tuple[Float[Tensor, "b 2"], Float[Tensor, "b n"]]:
    """Length scales, and variances of the tremor over those of the slow part."""
    whole = tremor.new_tensor(scales)
    weight = whole[:, 2:]
    return whole[:, :2], weight / (1.0 - weight) * tremor.square()


def _candidates(
    time: Float[Tensor, " n"], tremor: Float[Tensor, " n"], scales: Sequence[Scales], kernel: str
) -> Float[Tensor, "b n n"]:
    lengths, fine = _tensors(tremor, scales)
    return smooth_correlation(time, time, lengths, fine, fine, kernel)


def _search(
    grid: Tensor, residual: Float[Tensor, "K T 1"], steps: Bool[Tensor, " T"], kernel: str, near: float | None = None
) -> Found:
    """Likeliest length scale at some steps of an output, among all or among those near a previous one."""
    lengths = [length for length in _LENGTHS if near is None or near / _NEAR <= length <= near * _NEAR]
    candidates = [Scales(length, length, 0.0) for length in lengths]
    return _likeliest(grid, residual, steps, kernel, candidates, _NUGGETS, torch.zeros_like(grid))


def _with_tremor(
    grid: Tensor, residual: Tensor, steps: Tensor, kernel: str, single: Found, tremor: Float[Tensor, " T"]
) -> Found:
    """Likeliest of one length scale and of two on either side of it, where a tremor replaces part of the nugget."""
    length = single.scales.slow
    candidates = [
        Scales(slow, slow / ratio, weight)
        for ratio in _RATIOS
        for slow in _LENGTHS
        if length <= slow <= ratio * length
        for weight in _FINE_WEIGHTS
    ]
    nuggets = [nugget for nugget in _NUGGETS if nugget <= single.nugget]
    pairs = [_likeliest(grid, residual, steps, kernel, candidates, nuggets, tremor)] if candidates else []
    return max([single, *pairs])


def _likeliest(
    grid: Tensor,
    residual: Float[Tensor, "K T 1"],
    steps: Bool[Tensor, " T"],
    kernel: str,
    candidates: Sequence[Scales],
    nuggets: Sequence[float],
    tremor: Float[Tensor, " T"],
) -> Found:
    """Highest log likelihood of ``(1 - eta) K + eta I``, with its scales and shared nugget eta."""
    steps = steps if 2 * int(steps.sum()) >= len(grid) else torch.ones_like(steps)
    groups, time = _by_pattern(_unit_rms(residual[:, steps])), grid[steps]
    unit = _candidates(time, tremor[steps], candidates, kernel)
    values = []
    for nugget in nuggets:
        whole = (1.0 - nugget) * unit + nugget * torch.eye(len(time)).to(time)
        each = [_log_likelihood(whole[:, seen][:, :, seen], rows) for seen, rows in groups]
        values.append(torch.stack(each).sum(0))
    table = torch.stack(values)
    best = int(table.argmax())
    return Found(float(table.max()), candidates[best % len(candidates)], nuggets[best // len(candidates)])


def _log_likelihood(covariance: Float[Tensor, "b n n"], rows: Float[Tensor, "n s"]) -> Float[Tensor, " b"]:
    """Log density of the series in ``rows``, up to a constant; minus infinity where a matrix is singular."""
    root, info = torch.linalg.cholesky_ex(covariance)
    whitened = torch.linalg.solve_triangular(root, rows.expand(len(root), *rows.shape), upper=False)
    value = -0.5 * whitened.square().sum((1, 2)) - rows.shape[1] * root.diagonal(dim1=1, dim2=2).log().sum(1)
    return torch.where((info == 0) & torch.isfinite(value), value, -torch.inf)


def _step_nuggets(unit: Float[Tensor, "T T"], residual: Float[Tensor, "K T d"], least: float) -> Float[Tensor, " T"]:
    """Nugget of each step, by expectation maximization over the independent parts of the residuals.

    With ``S = K + diag e`` and ``a = S^-1 z`` an independent part has the mean ``e_t a_t`` and the variance
    ``e_t - e_t^2 [S^-1]_tt``; their second moment is the next e_t.
    """
    groups = _by_pattern(residual)
    nugget = torch.full_like(unit[0], max(least, _FIRST))
    for _ in range(_N_STEPS):
        moment, count = torch.zeros_like(nugget), torch.zeros_like(nugget)
        for seen, rows in groups:
            own = nugget[seen]
            inverse = torch.cholesky_inverse(
                safe_cholesky(unit[seen][:, seen] + torch.diag(own), name="the time kernel")
            )
            second = (own[:, None] * (inverse @ rows)).square().sum(1)
            moment[seen] += second + rows.shape[1] * (own - own.square() * inverse.diagonal())
            count[seen] += rows.shape[1]
        new = torch.where(count > 0, moment / count.clamp_min(1.0), nugget).clamp(least, _MOST)
        change = (new / nugget).log().abs().max()
        nugget = new
        if float(change) < _TOLERANCE:
            break
    return nugget


def _left_out(kernel: TimeKernel, shares: Sequence[float]) -> tuple[float, float]:
    """Highest log likelihood of the demonstrations, each under the law of the others' residuals, and its share.

    In this law ``z = C^-1 y``, y has the covariance ``S = share R + (1 - share) / (K - 1) sum z z'`` over the
    others, and ``C_t = chol S_tt`` keeps the marginals: it bends the smooth part, at a cost where that has little
    variance. With the Gram matrix G of all under R^-1, ``M = G + a I``, ``a = share (K - 1) / (1 - share)`` and
    ``c = Z' R^-1 y``, the squared distance is ``(y' R^-1 y - c' M^-1 c) / share`` and the determinant that of M over
    the others, whose inverse follows from that of all by removing one row.
    """
    n_demos, n_steps, d = kernel.residual.shape
    if n_demos < 3:  # a single other demonstration has no covariance
        return 0.0, shares[0]
    root = safe_cholesky(kernel.correlation(kernel.grid, kernel.grid), name="the correlation along the movement")
    residual = kernel.residual

    def whiten(rows: Float[Tensor, "K T d"]) -> Float[Tensor, "K s"]:
        return torch.linalg.solve_triangular(root, rows.permute(2, 1, 0), upper=False).flatten(0, 1).mT

    whitened = whiten(residual)
    gram, outer = symmetrize(whitened @ whitened.mT), residual[..., None] * residual[..., None, :]
    unit, others = torch.eye(d).to(gram), (outer.sum(0) - outer) / (n_demos - 1)

    def left_out(share: float) -> float:
        if share == 1.0:
            return -0.5 * float(gram.trace())
        factor = torch.linalg.cholesky(share * unit + (1.0 - share) * others)
        inner = whiten((factor @ residual[..., None])[..., 0])
        ridge = share * (n_demos - 1) / (1.0 - share)
        inverse = torch.linalg.inv(gram + ridge * torch.eye(n_demos).to(gram))
        own = inverse.diagonal()
        cross = (inner @ whitened.mT).fill_diagonal_(0.0)  # one row a demonstration, without itself
        solved = cross @ inverse
        explained = (cross * solved).sum(1) - solved.diagonal().square() / own
        square = (inner.square().sum(1) - explained) / share
        # log det of share (I + G / a) over the others
        log_det = n_steps * d * math.log(share) - (n_demos - 1) * math.log(ridge) + own.log() - torch.logdet(inverse)
        return float((factor.diagonal(dim1=-2, dim2=-1).log().sum((1, 2)) - 0.5 * (square + log_det)).sum())

    # The same for all shares, but not for all kernels.
    unit_log_det = n_demos * float(root.diagonal(dim1=1, dim2=2).log().sum())
    values = list(map(left_out, shares))
    return max(values) - unit_log_det, shares[values.index(max(values))]


def _by_pattern(residual: Float[Tensor, "K T d"]) -> list[tuple[Tensor, Tensor]]:
    """Steps that demonstrations have, and the series of those that have the same: ((T,), (n, series)) each."""
    seen = ~residual.isnan().any(2)
    patterns, index = torch.unique(seen, dim=0, return_inverse=True)
    pairs = []
    for number, pattern in enumerate(patterns):
        if bool(pattern.any()):
            rows = residual[index == number][:, pattern]
            pairs.append((pattern, rows.permute(1, 0, 2).reshape(int(pattern.sum()), -1)))
    return pairs


def _unit_rms(residual: Tensor) -> Tensor:
    # Demonstrations that are one have no residuals, and keep none.
    return residual / residual.square().nanmean().sqrt().clamp_min(torch.finfo(residual.dtype).tiny)
