"""Fit of the time kernel of one output: length scales by likelihood alternating with nuggets by EM."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky
from torch_pbd.movement.time_kernel import TimeKernel, smooth_correlation

# Candidate length scales in ranges of the time, from the spacing of fifty steps to a movement that bends once, and
# candidate nuggets shared by all steps.
_LENGTHS = torch.logspace(math.log10(0.02), 0.0, 14, dtype=torch.float64).tolist()
# Factors that refine a length scale, from the candidate before it to the next, beyond the ends too. Without them the
# law of smooth movements is a third farther from the truth.
_BETWEEN = [(_LENGTHS[1] / _LENGTHS[0]) ** (step / 6.0) for step in range(-6, 7)]
_NUGGETS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1)
# Candidate variances of the tremor over the slow part's at a usual step: 3, 10, 30 and 60 % of that of both.
_FINE = tuple(weight / (1.0 - weight) for weight in (0.03, 0.1, 0.3, 0.6))
_RATIOS = (2.0, 4.0)  # candidate ratios of the slow length scale to the tremor's
_LEAST, _MOST, _FIRST = 1e-6, 1e3, 1e-2  # nuggets: smallest, largest, and where expectation maximization starts
_N_STEPS, _TOLERANCE = 40, 0.02  # expectation maximization: most iterations, and change of a logarithm that ends it
_SMOOTH = 1e-3  # largest nugget of a step that is distinguished from noise: such steps determine the length scale
_NEAR = 2.5  # factor around a length scale within which it is searched again once there are nuggets
_USUAL = 2.0  # factor around the median within which the size of a step's residuals is usual
_MOST_FIRST = 100  # most steps of the first search: two for each shortest length scale
_ROUNDS = 3  # alternations of nuggets and length scale, which depend on each other

# Length scales of the slow part and of the tremor, and the ratio of their variances at a usual step, 0 without one.
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


@dataclass(frozen=True)
class OutputSeries:
    """Whitened residuals of one output, NaN where missing, and the size of a tremor at each step."""

    grid: Float[Tensor, " T"]
    residual: Float[Tensor, "K T"]
    tremor: Float[Tensor, " T"]

    def start(self, kernel: str) -> Start:
        """Likeliest length scale of the usual steps, and the nugget of each step under it."""
        usual = self.usual_steps().nonzero()[:, 0]
        found = self.search(usual[:: math.ceil(len(usual) / _MOST_FIRST)], kernel)
        nugget, unit = self._step_nuggets(found.scales, kernel, _LEAST), self._candidates([found.scales], kernel)[0]
        return Start(found, nugget, float(_log_likelihood((unit + torch.diag(nugget))[None], self.residual)))

    def fit(self, kernel: str, start: Start, is_sum: bool) -> TimeKernel:
        """Scales and nuggets in alternation."""
        single, nugget = start.found, start.nugget
        found = self._with_tremor(self.usual_steps(), kernel, single) if is_sum else single
        nugget = self._step_nuggets(found.scales, kernel, _LEAST) if is_sum else nugget
        for _ in range(_ROUNDS):
            smooth = nugget <= _SMOOTH
            steps = smooth if 2 * smooth.sum() >= len(self.grid) else nugget <= nugget.median()
            before, single = found, self.search(steps, kernel, near=single.scales[0])
            found = self._with_tremor(steps, kernel, single) if is_sum else single
            if found[1:] == before[1:]:
                break
            nugget = self._step_nuggets(found.scales, kernel, min(found.nugget, 0.1 * _SMOOTH))
        return self._refined(kernel, found.scales, nugget)

    def refit(self, before: TimeKernel, number: int) -> TimeKernel:
        """Nuggets, and scales around those of one of the outputs before, whose tremor was of the same size."""
        ratio = float((before.fine[number] / self.tremor.square()).median())
        scales = (*before.scales[number].tolist(), ratio)
        nugget = self._step_nuggets(scales, before.kernel, float(before.nugget[number].min()))
        return self._refined(before.kernel, scales, nugget)

    def _refined(self, kernel: str, scales: Scales, nugget: Float[Tensor, " T"]) -> TimeKernel:
        """Time kernel of the likeliest scales around these, of all steps with the nugget of each."""
        slow, fast, ratio = scales
        candidates = [(factor * slow, factor * fast, ratio) for factor in _BETWEEN]
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

    def search(self, steps: Tensor, kernel: str, near: float | None = None) -> Found:
        """Likeliest length scale at some steps, numbers or a mask, among all or among those near a previous one."""
        lengths = [length for length in _LENGTHS if near is None or near / _NEAR <= length <= near * _NEAR]
        return self._likeliest(steps, kernel, [(length, length, 0.0) for length in lengths], _NUGGETS)

    def _with_tremor(self, steps: Tensor, kernel: str, single: Found) -> Found:
        """Likeliest of one length scale and of two on either side of it, where a tremor replaces part of the nugget."""
        length = single.scales[0]
        choices = itertools.product(_RATIOS, _LENGTHS, _FINE)
        pairs = [(slow, slow / ratio, fine) for ratio, slow, fine in choices if length <= slow <= ratio * length]
        nuggets = [nugget for nugget in _NUGGETS if nugget <= single.nugget]
        return self._likeliest(steps, kernel, [single.scales, *pairs], nuggets)

    def _likeliest(self, steps: Tensor, kernel: str, candidates: Sequence[Scales], nuggets: Sequence[float]) -> Found:
        """Highest log likelihood of ``(1 - eta) K + eta I`` at some steps, with its scales and shared nugget eta."""
        rows, unit = unit_rms(self.residual[:, steps]), self._candidates(candidates, kernel, steps)
        eye = torch.eye(unit.shape[1]).to(unit)
        table = torch.stack([_log_likelihood(torch.lerp(unit, eye, eta), rows) for eta in nuggets])
        best = int(table.argmax())
        return Found(float(table.max()), candidates[best % len(candidates)], nuggets[best // len(candidates)])

    def _parts(self, scales: Sequence[Scales]) -> tuple[Float[Tensor, "b 2"], Float[Tensor, "b T"]]:
        """Length scales, and variances of the tremor over those of the slow part."""
        whole = self.tremor.new_tensor(scales)
        return whole[:, :2], whole[:, 2:] * self.tremor.square()

    def _candidates(
        self, scales: Sequence[Scales], kernel: str, steps: Tensor | slice = slice(None)
    ) -> Float[Tensor, "b n n"]:
        """Correlation between some of the steps, without nuggets, for each of the scales."""
        (lengths, fine), time = self._parts(scales), self.grid[steps]
        return smooth_correlation(time, time, lengths, fine[:, steps], fine[:, steps], kernel)

    def _step_nuggets(self, scales: Scales, kernel: str, least: float) -> Float[Tensor, " T"]:
        """Nugget of each step, by expectation maximization over the independent parts of the residuals.

        With ``S = K + diag e`` and ``a = S^-1 z`` an independent part has the mean ``e_t a_t`` and the variance
        ``e_t - e_t^2 [S^-1]_tt``; their second moment is the next e_t.
        """
        unit = self._candidates([scales], kernel)[0]
        groups = [(unit[seen][:, seen], seen, rows) for seen, rows in _by_pattern(self.residual)]
        nugget = torch.full_like(self.grid, max(least, _FIRST))
        for _ in range(_N_STEPS):
            moment, count = torch.zeros_like(nugget), torch.zeros_like(nugget)
            for part, seen, rows in groups:
                own = nugget[seen]
                root = safe_cholesky(part + torch.diag(own), name="the time kernel")
                inverse = torch.cholesky_inverse(root)
                second = (own[:, None] * (inverse @ rows)).square().sum(1)
                moment[seen] += second + rows.shape[1] * (own - own.square() * inverse.diagonal())
                count[seen] += rows.shape[1]
            new = torch.where(count > 0, moment / count.clamp_min(1.0), nugget).clamp(least, _MOST)
            change, nugget = (new / nugget).log().abs().max(), new
            if float(change) < _TOLERANCE:
                break
        return nugget


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


def unit_rms(residual: Tensor) -> Tensor:
    """Residuals over their root mean square; demonstrations that are one have none, and keep none."""
    return residual / residual.square().nanmean().sqrt().clamp_min(torch.finfo(residual.dtype).tiny)
