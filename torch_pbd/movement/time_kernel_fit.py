"""Fit of time kernels: length scales by likelihood alternating with nuggets by EM, then the kernel's share."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.linalg import safe_cholesky
from torch_pbd.movement.time_kernel import TimeKernel, left_out, smooth_correlation

# Candidate length scales in ranges of the time, from the spacing of fifty steps to a movement that bends once, and
# candidate nuggets shared by all steps.
_LENGTHS = torch.logspace(math.log10(0.02), 0.0, 14, dtype=torch.float64).tolist()
# Factors from the one before to the next of these, at their ends too: smooth laws are a third farther without.
_BETWEEN = [(_LENGTHS[1] / _LENGTHS[0]) ** (step / 6.0) for step in range(-6, 7)]
_NUGGETS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
_FINE_WEIGHTS = (0.03, 0.1, 0.3, 0.6)  # candidate shares of the tremor in the variance at a usual step
_RATIOS = (2.0, 4.0)  # candidate ratios of the slow length scale to the tremor's
_LEAST, _MOST, _FIRST = 1e-6, 1e3, 1e-2  # nuggets: smallest, largest, and where expectation maximization starts
_N_STEPS, _TOLERANCE = 40, 0.02  # expectation maximization: most iterations, and change of a logarithm that ends it
_SMOOTH = 1e-3  # largest nugget of a step that is distinguished from noise: such steps determine the length scale
_NEAR = 2.5  # factor around a length scale within which it is searched again once there are nuggets
_USUAL = 2.0  # factor around the median within which the size of a step's residuals is usual
_MOST_FIRST = 100  # steps of the first search: twice as many as the shortest length scale is spacings of
_ROUNDS = 3  # alternations of nuggets and length scale, which depend on each other
# Nats a demonstration. Kernels that a step of noise had decided on lost 14 to 99, of recordings others gained up to 9
# and left-out demonstrations nothing.
_CLEARLY = 10.0
# Outputs are sorted in steps of this factor of their squared second differences, counted from the smoothest one's.
_ROUGHER = 4.0
FEWEST_DF = 3.0
"""Least degrees of freedom of a movement, whose variance must exist."""

_STILL = 1e-3  # rms of residuals, over their predicted deviation, of an output that does not vary
_N_DF = 40  # candidates between the most and the fewest
_FITS = 2  # of the time kernel: the second one weighs demonstrations whose sizes differ
_EVEN = 30.0  # degrees of freedom from which sizes differ too little, by 13 %, to fit the kernel again
_SHARES = (1.0, 0.9, 0.75, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05)  # candidate weights of the kernel in the correlation


# Length scales of the slow part and of the tremor, and the tremor's weight at a usual step, 0 without one.
Scales = tuple[float, float, float]


class Found(NamedTuple):
    """Likeliest scales of an output, and its nugget, shared by all steps."""

    log_likelihood: float
    scales: Scales
    nugget: float


class Start(NamedTuple):
    """Likeliest length scale of an output's usual steps, and the nugget of each step that goes with it."""

    found: Found
    nugget: Float[Tensor, " T"]
    log_likelihood: float
    """Of all steps."""


def fit_time_kernel(
    grid: Float[Tensor, " T"],
    residual: Float[Tensor, "K T d"],
    deviation: Float[Tensor, "T d"],
    kernels: Sequence[str],
    share: float | None,
) -> tuple[TimeKernel, Float[Tensor, " K"]]:
    """Time kernel of whitened residuals, NaN where a demonstration has no sample near, over times of range one.

    Each output's residuals, given those that are smoother, were divided by its ``deviation``. The likeliest of the
    ``kernels`` is taken, another where demonstrations left out in turn are clearly likelier, and for ``share`` None the
    share under which they are likeliest. The second is their squared distance each under the law of the others.
    """
    parts, tremor = map(_unit_rms, residual.unbind(2)), deviation.median(0).values / deviation
    outputs = [_Output(grid, *part) for part in zip(parts, tremor.mT, strict=True)]
    starts = {name: [each.start(name) for each in outputs] for name in kernels}
    # By the usual steps alone, and by all, each with its own nugget: where the two agree no other kernel is fitted.
    usual = max(kernels, key=lambda name: sum(start.found.log_likelihood for start in starts[name]))
    other = max(kernels, key=lambda name: sum(start.log_likelihood for start in starts[name]))
    shares = _SHARES if share is None else (share,)
    whole = _fit_outputs(outputs, usual, starts[usual], shares)
    judged = left_out(whole, shares)
    if other != usual:
        instead = _fit_outputs(outputs, other, starts[other], shares)
        its_own = left_out(instead, shares)
        if its_own.log_likelihood > judged.log_likelihood + _CLEARLY * len(residual):
            whole, judged = instead, its_own
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
    size, weight = (~residual[..., varies].isnan()).sum((1, 2)), residual.new_ones(len(residual))
    for _ in range(_FITS):
        weighted = weight[:, None, None] * residual
        found, square = fit_time_kernel(grid, weighted, deviation, kernels, share)
        kernels = (found.kernel,)
        # The kernel is of weighted residuals, each output's over its rms; these are about the unweighted ones' squares.
        square = square * weighted.square().nanmean() / (weight.square() * residual.square().nanmean())
        df = most if is_even else movement_df(square, size, most)
        if df >= min(most, _EVEN):
            break
        # Expectation maximization of Student's t: each demonstration counts by the expected inverse square of its size,
        # so that large and restless ones do not make draws of all too long and too rough.
        weight = ((df + size) / (df - 2.0 + square)).sqrt()
    return found, df


def movement_df(square: Float[Tensor, " K"], size: Int64[Tensor, " K"], most: float) -> float:
    """Degrees of freedom, at most ``most``, under which left-out demonstrations of this square and size are likeliest.

    The covariance is the same under all. The few whose marginals were learned from them too differ less in size than a
    new one does, so that this can tell of fewer degrees of freedom than others do, not of more.
    """
    df = most * (FEWEST_DF / most) ** torch.linspace(0.0, 1.0, _N_DF, dtype=torch.float64)[:, None]
    value = torch.lgamma(0.5 * (df + size)) - torch.lgamma(0.5 * df) - 0.5 * size * (df - 2.0).log()
    value = value - 0.5 * (df + size) * torch.log1p(square / (df - 2.0))
    return max(FEWEST_DF, float(df[value.sum(1).argmax()]))


def _fit_outputs(
    outputs: Sequence["_Output"], kernel: str, starts: Sequence[Start], shares: Sequence[float]
) -> TimeKernel:
    """Time kernel of all outputs, of each with a tremor where left-out demonstrations are likelier so."""
    fitted = []
    for output, start in zip(outputs, starts, strict=True):
        # A tremor that makes the residuals of one output likelier need not do so jointly with those of the others.
        results = [output.fit(kernel, start, is_sum) for is_sum in (False, True)]
        fitted.append(max(results, key=lambda result: left_out(result, shares).log_likelihood))
    stacked = {name: torch.cat([getattr(each, name) for each in fitted]) for name in ("scales", "fine", "nugget")}
    filled = torch.cat([each.residual for each in fitted], dim=2)
    return TimeKernel(kernel, grid=outputs[0].grid, **stacked, residual=filled, share=filled.new_ones(()))


@dataclass(frozen=True)
class _Output:
    """Whitened residuals of one output, NaN where missing, and the size of a tremor at each step."""

    grid: Float[Tensor, " T"]
    residual: Float[Tensor, "K T"]
    tremor: Float[Tensor, " T"]

    def start(self, kernel: str) -> Start:
        """Likeliest length scale of the usual steps, and the nugget of each step under it."""
        usual = self.usual_steps().nonzero()[:, 0]
        some = torch.zeros_like(self.grid, dtype=torch.bool)
        some[usual[:: math.ceil(len(usual) / _MOST_FIRST)]] = True
        found = self.search(some, kernel)
        unit = self._candidates([found.scales], kernel)[0]
        nugget = self._step_nuggets(unit, _LEAST)
        return Start(found, nugget, float(_log_likelihood((unit + torch.diag(nugget))[None], self.residual)))

    def fit(self, kernel: str, start: Start, is_sum: bool) -> TimeKernel:
        """Scales and nuggets in alternation."""
        single, nugget = start.found, start.nugget
        found = self._with_tremor(self.usual_steps(), kernel, single) if is_sum else single
        unit = self._candidates([found.scales], kernel)[0]
        nugget = self._step_nuggets(unit, _LEAST) if is_sum else nugget
        for _ in range(_ROUNDS):
            smooth = nugget <= _SMOOTH
            steps = smooth if 2 * smooth.sum() >= len(self.grid) else nugget <= nugget.median()
            before, single = found, self.search(steps, kernel, near=single.scales[0])
            found = self._with_tremor(steps, kernel, single) if is_sum else single
            if found[1:] == before[1:]:
                break
            unit = self._candidates([found.scales], kernel)[0]
            nugget = self._step_nuggets(unit, min(found.nugget, 0.1 * _SMOOTH))
        # The likeliest scales around those found, of all steps with the nugget of each.
        slow, fast, weight = found.scales
        candidates = [(factor * slow, factor * fast, weight) for factor in _BETWEEN]
        units = self._candidates(candidates, kernel)
        best = int(_log_likelihood(units + torch.diag(nugget), self.residual).argmax())
        unit = units[best]
        filled = self.residual.clone()
        for own in filled:  # the kernel's expectation where there were no samples
            seen = ~own.isnan()
            root = safe_cholesky(unit[seen][:, seen] + torch.diag(nugget[seen]), name="the time kernel")
            own[~seen] = (unit[~seen][:, seen] @ torch.cholesky_solve(own[seen, None], root))[:, 0]
        lengths, fine = self._parts([candidates[best]])
        parts = {"grid": self.grid, "scales": lengths, "fine": fine, "nugget": nugget[None]}
        return TimeKernel(kernel, **parts, residual=filled[..., None], share=nugget.new_ones(()))

    def usual_steps(self) -> Bool[Tensor, " T"]:
        """Steps at which residuals are of about the median size, or all where these are fewer than half."""
        sizes = self.residual.square().nanmean(0).sqrt()
        usual = (sizes > sizes.nanmedian() / _USUAL) & (sizes < sizes.nanmedian() * _USUAL)
        return usual if 2 * int(usual.sum()) >= len(usual) else torch.ones_like(usual)

    def search(self, steps: Bool[Tensor, " T"], kernel: str, near: float | None = None) -> Found:
        """Likeliest length scale at some steps, among all or among those near a previous one."""
        lengths = [length for length in _LENGTHS if near is None or near / _NEAR <= length <= near * _NEAR]
        return self._likeliest(steps, kernel, [(length, length, 0.0) for length in lengths], _NUGGETS)

    def _with_tremor(self, steps: Bool[Tensor, " T"], kernel: str, single: Found) -> Found:
        """Likeliest of one length scale and of two on either side of it, where a tremor replaces part of the nugget."""
        length = single.scales[0]
        choices = itertools.product(_RATIOS, _LENGTHS, _FINE_WEIGHTS)
        pairs = [(slow, slow / ratio, weight) for ratio, slow, weight in choices if length <= slow <= ratio * length]
        nuggets = [nugget for nugget in _NUGGETS if nugget <= single.nugget]
        return self._likeliest(steps, kernel, [single.scales, *pairs], nuggets)

    def _likeliest(
        self, steps: Bool[Tensor, " T"], kernel: str, candidates: Sequence[Scales], nuggets: Sequence[float]
    ) -> Found:
        """Highest log likelihood of ``(1 - eta) K + eta I`` at some steps, with its scales and shared nugget eta."""
        rows, unit = _unit_rms(self.residual[:, steps]), self._candidates(candidates, kernel, steps)
        eye = torch.eye(unit.shape[1]).to(unit)
        table = torch.stack([_log_likelihood(torch.lerp(unit, eye, eta), rows) for eta in nuggets])
        best = int(table.argmax())
        return Found(float(table.max()), candidates[best % len(candidates)], nuggets[best // len(candidates)])

    def _parts(self, scales: Sequence[Scales]) -> tuple[Float[Tensor, "b 2"], Float[Tensor, "b T"]]:
        """Length scales, and variances of the tremor over those of the slow part."""
        whole = self.tremor.new_tensor(scales)
        weight = whole[:, 2:]
        return whole[:, :2], weight / (1.0 - weight) * self.tremor.square()

    def _candidates(
        self, scales: Sequence[Scales], kernel: str, steps: Tensor | slice = slice(None)
    ) -> Float[Tensor, "b n n"]:
        """Correlation between some of the steps, without nuggets, for each of the scales."""
        (lengths, fine), time = self._parts(scales), self.grid[steps]
        return smooth_correlation(time, time, lengths, fine[:, steps], fine[:, steps], kernel)

    def _step_nuggets(self, unit: Float[Tensor, "T T"], least: float) -> Float[Tensor, " T"]:
        """Nugget of each step, by expectation maximization over the independent parts of the residuals.

        With ``S = K + diag e`` and ``a = S^-1 z`` an independent part has the mean ``e_t a_t`` and the variance
        ``e_t - e_t^2 [S^-1]_tt``; their second moment is the next e_t.
        """
        groups, nugget = _by_pattern(self.residual), torch.full_like(self.grid, max(least, _FIRST))
        for _ in range(_N_STEPS):
            moment, count = torch.zeros_like(nugget), torch.zeros_like(nugget)
            for seen, rows in groups:
                own = nugget[seen]
                root = safe_cholesky(unit[seen][:, seen] + torch.diag(own), name="the time kernel")
                inverse = torch.cholesky_inverse(root)
                second = (own[:, None] * (inverse @ rows)).square().sum(1)
                moment[seen] += second + rows.shape[1] * (own - own.square() * inverse.diagonal())
                count[seen] += rows.shape[1]
            new = torch.where(count > 0, moment / count.clamp_min(1.0), nugget).clamp(least, _MOST)
            change, nugget = (new / nugget).log().abs().max(), new
            if float(change) < _TOLERANCE:
                break
        return nugget


def smoothest_first(residual: Float[Tensor, "K T d"]) -> Int64[Tensor, " d"]:
    """Order in which each output is given those before it, by residuals over their deviations at each step.

    What trembles in one is passed on to those after it as far as they vary together, and draws of smooth outputs given
    a rough one would be as rough. Steps of noise, as where movements end at one point, do not decide on a median.
    """
    if residual.shape[1] < 3:
        return torch.arange(residual.shape[2])
    bend, size = (part.square().nanmean(0).nanmedian(0).values for part in (residual.diff(n=2, dim=1), residual))
    bend = (bend / size).nan_to_num(nan=1.0, posinf=1.0).clamp_min(_LEAST)  # of a constant output
    return ((bend / bend.min()).log() / math.log(_ROUGHER)).floor().argsort(stable=True)


def _log_likelihood(covariance: Float[Tensor, "b n n"], residual: Float[Tensor, "K n"]) -> Float[Tensor, " b"]:
    """Log density of series with holes, up to a constant; minus infinity where a matrix is singular."""
    total = covariance.new_zeros(len(covariance))
    for seen, rows in _by_pattern(residual):
        own = covariance if bool(seen.all()) else covariance[:, seen][:, :, seen]
        root, info = torch.linalg.cholesky_ex(own)
        whitened = torch.linalg.solve_triangular(root, rows.expand(len(root), *rows.shape), upper=False)
        value = -0.5 * whitened.square().sum((1, 2)) - rows.shape[1] * root.diagonal(dim1=1, dim2=2).log().sum(1)
        total += torch.where((info == 0) & torch.isfinite(value), value, -torch.inf)
    return total


def _by_pattern(residual: Float[Tensor, "K T"]) -> list[tuple[Tensor, Tensor]]:
    """Steps that demonstrations have, and the series of those that have the same: ((T,), (n, series)) each."""
    patterns, index = torch.unique(~residual.isnan(), dim=0, return_inverse=True)
    return [(seen, residual[index == number][:, seen].mT) for number, seen in enumerate(patterns) if bool(seen.any())]


def _unit_rms(residual: Tensor) -> Tensor:
    # Demonstrations that are one have no residuals, and keep none.
    return residual / residual.square().nanmean().sqrt().clamp_min(torch.finfo(residual.dtype).tiny)
