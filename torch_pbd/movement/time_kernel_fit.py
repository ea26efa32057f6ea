"""Fit of time kernels: of those of all outputs the likeliest, its share, and weights of the demonstrations."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import log_density_at
from torch_pbd.movement.output_kernel import OutputSeries, Start, unit_rms
from torch_pbd.movement.time_kernel import LeftOut, TimeKernel, left_out

# Nats a demonstration by which another kernel must be likelier. Where a step of noise had decided the choice lost 14 to
# 99; by differences of up to 9 left-out demonstrations gained nothing.
_CLEARLY = 10.0
# Outputs are sorted in steps of this factor of their squared second differences, counted from the smoothest one's, or
# from the least that counts.
_ROUGHER, _SMOOTHEST = 4.0, 1e-6
FEWEST_DF = 3.0
"""Least degrees of freedom of a movement, whose variance must exist."""

_STILL = 1e-3  # rms of residuals, over their predicted deviation, of an output that does not vary
_N_DF = 40  # candidate degrees of freedom
_EVEN = 30.0  # degrees of freedom from which sizes differ too little, by 13 %, to weigh demonstrations by them
_SHARES = (1.0, 0.9, 0.75, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05)  # candidate weights of the kernel in the correlation


def fit_time_kernel(
    grid: Float[Tensor, " T"],
    residual: Float[Tensor, "K T d"],
    deviation: Float[Tensor, "T d"],
    kernels: Sequence[str],
    share: float | None,
    before: TimeKernel | None = None,
) -> tuple[TimeKernel, Float[Tensor, " K"]]:
    """Time kernel of whitened residuals, NaN where a demonstration has no sample near, over times of range one.

    Each output's residuals, given those that are smoother, were divided by its ``deviation``. The likeliest of the
    ``kernels`` is taken, another where demonstrations left out in turn are clearly likelier, and for ``share`` None the
    share under which they are likeliest. The second is their squared distance each under the law of the others.
    The kind of one ``before``, of nearly the same residuals, is kept and its scales are refined: the search is saved.
    """
    parts, tremor = map(unit_rms, residual.unbind(2)), deviation.median(0).values / deviation
    outputs = [OutputSeries(grid, *part) for part in zip(parts, tremor.mT, strict=True)]
    shares = _SHARES if share is None else (share,)
    if before is None:
        whole, judged = _likeliest_kernel(outputs, kernels, shares)
    else:
        whole = _joined([each.refit(before, number) for number, each in enumerate(outputs)])
        judged = left_out(whole, shares)
    whole.share.fill_(judged.share)
    return whole, judged.square


def fit_weighted(
    grid: Float[Tensor, " T"],
    residual: Float[Tensor, "K T d"],
    deviation: Float[Tensor, "T d"],
    kernels: Sequence[str],
    share: float | None,
    most: float,
    *,
    is_even: bool,
) -> tuple[TimeKernel, float]:
    """Time kernel as of :func:`fit_time_kernel`, and a movement's degrees of freedom: ``most`` where sizes are even."""
    # Of an output that does not vary, rounding is left: it says nothing of sizes.
    varies = residual.square().nanmean((0, 1)) > _STILL**2
    residual = torch.where(varies, residual, 0.0 * residual)
    size = (~residual[..., varies].isnan()).sum((1, 2))
    found, square = fit_time_kernel(grid, residual, deviation, kernels, share)
    df = most if is_even else movement_df(square, size, most)
    if df >= min(most, _EVEN):
        return found, df
    # Expectation maximization of Student's t: each demonstration counts by the expected inverse square of its size, so
    # that large and restless ones do not make draws of all too long and too rough.
    weight = ((df + size) / (df - 2.0 + square)).sqrt()
    weighted = weight[:, None, None] * residual
    found, square = fit_time_kernel(grid, weighted, deviation, (found.kernel,), share, found)
    # The kernel is of weighted residuals, each output's over its rms; these are about the unweighted ones' squares.
    square = square * weighted.square().nanmean() / (weight.square() * residual.square().nanmean())
    return found, movement_df(square, size, most)


def movement_df(square: Float[Tensor, " K"], size: Int64[Tensor, " K"], most: float) -> float:
    """Degrees of freedom, at most ``most``, under which left-out demonstrations of this square and size are likeliest.

    The covariance is the same under all. Demonstrations whose marginals were learned from them too differ less in size
    than a new one does: these may say fewer degrees of freedom than ``most``, never more.
    """
    df = most * (FEWEST_DF / most) ** torch.linspace(0.0, 1.0, _N_DF, dtype=torch.float64)[:, None]
    return max(FEWEST_DF, float(df[log_density_at(square, size, df).sum(1).argmax()]))


def _likeliest_kernel(
    outputs: Sequence[OutputSeries], kernels: Sequence[str], shares: Sequence[float]
) -> tuple[TimeKernel, LeftOut]:
    """Time kernel of all outputs, and demonstrations left out in turn of it."""
    starts = {name: [each.start(name) for each in outputs] for name in kernels}
    # By the usual steps alone, and by all, each with its own nugget: where the two agree no other kernel is fitted.
    usual = max(kernels, key=lambda name: sum(start.found.log_likelihood for start in starts[name]))
    other = max(kernels, key=lambda name: sum(start.log_likelihood for start in starts[name]))
    whole = _fit_outputs(outputs, usual, starts[usual], shares)
    judged = left_out(whole, shares)
    if other != usual:
        instead = _fit_outputs(outputs, other, starts[other], shares)
        its_own = left_out(instead, shares)
        if its_own.log_likelihood > judged.log_likelihood + _CLEARLY * len(whole.residual):
            return instead, its_own
    return whole, judged


def _fit_outputs(
    outputs: Sequence[OutputSeries], kernel: str, starts: Sequence[Start], shares: Sequence[float]
) -> TimeKernel:
    """Time kernel of all outputs, of each with a tremor where left-out demonstrations are likelier so."""
    fitted = []
    for output, start in zip(outputs, starts, strict=True):
        # A tremor that makes the residuals of one output likelier need not do so jointly with those of the others.
        results = [output.fit(kernel, start, is_sum) for is_sum in (False, True)]
        fitted.append(max(results, key=lambda result: left_out(result, shares).log_likelihood))
    return _joined(fitted)


def _joined(fitted: Sequence[TimeKernel]) -> TimeKernel:
    """Time kernel of all outputs, from those of each."""
    parts = {name: torch.cat([getattr(each, name) for each in fitted]) for name in ("scales", "fine", "nugget")}
    filled, one = torch.cat([each.residual for each in fitted], dim=2), fitted[0]
    return TimeKernel(one.kernel, grid=one.grid, **parts, residual=filled, share=one.share)


def smoothest_first(residual: Float[Tensor, "K T d"]) -> Int64[Tensor, " d"]:
    """Order in which each output is given those before it, by residuals over their deviations at each step.

    What trembles in one is passed on to those after it as far as they vary together, and draws of smooth outputs given
    a rough one would be as rough. Steps of noise, as where movements end at one point, do not decide on a median.
    """
    if residual.shape[1] < 3:
        return torch.arange(residual.shape[2])
    bend, size = (part.square().nanmean(0).nanmedian(0).values for part in (residual.diff(n=2, dim=1), residual))
    bend = (bend / size).nan_to_num(nan=1.0, posinf=1.0).clamp_min(_SMOOTHEST)  # of a constant output
    return ((bend / bend.min()).log() / math.log(_ROUGHER)).floor().argsort(stable=True)
