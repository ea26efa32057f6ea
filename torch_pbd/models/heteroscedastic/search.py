"""Inducing inputs that the model's processes rest on, and the search for hyperparameters by their evidence.

Movements that start or end at one point have deviations that collapse there. One process has one length scale, and that
of a deviation which is even for nineteen twentieths of a movement and falls by thirty in the last is neither the one
nor the other. Where the evidence is clearly higher so the inputs of the covariance's processes are stretched at an end.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.files.memory import require_much
from torch_pbd.gp.observations import spacing
from torch_pbd.models.heteroscedastic.log_variance import Squares, log_variance_evidence
from torch_pbd.models.heteroscedastic.processes import Evidence, FixedFeatures, ProcessFamily, inducing_inputs
from torch_pbd.optim.batch import FitReport, Progress, Status, first_failure, guarded, minimize_batch

# Prior medians of length scale (in ranges of the input) and amplitude, and prior deviation of the constant. Means
# are of outputs with unit variance, log variances and coefficients of residuals with a pooled unit covariance.
_MEAN = (0.3, 1.2, 0.0)
_LOG_VARIANCE = (0.5, 1.0, 2.0)
COEFFICIENT: dict[str, Any] = {"length_scale": 0.5, "amplitude": 0.3, "constant": 1.0}

# By default, for one column of X and for several, and where these do not resolve what is learned. At most of all
# outputs together, for the mean and for the covariance, as a fit takes the cube of these; but a dozen for each output.
_OF_ONE, _OF_SEVERAL, _MOST, _TOGETHER, _FEWEST = 48, 128, 128, (800, 400), 12

# Length scales, in ranges of the inputs, short to long by threes; and logarithms of amplitudes, weak and strong.
_STARTS = tuple(product((0.04, 0.12, 0.35, 1.0), (-1.0, 0.5)))
_SMALL = 1_000  # entries of all processes' kernel matrices

# An end gets as much length as the whole range has, most of it within the first of these shares of the range (a spacing
# of the inputs at least) or the second: a process of a usual length scale is then as free there as elsewhere in all.
_LENGTH, _WIDTHS = 1.0, (0.02, 0.06)
# An end is tried where deviations in its first hundredth are below this share of those from 5 to 15 % of the range, of
# some output: a process of a usual length scale follows what falls less.
_FALLS = 1.0 / 3.0
# Nats: an end that falls by thirty gains some fifty from six demonstrations. One of nine recorded sets gained up to
# eleven, and lost a tenth of a nat a step of what was left out.
_CLEARLY = 20.0


class Families(NamedTuple):
    """Families of the processes of the mean, and of the log variances."""

    mean: ProcessFamily
    log_variance: ProcessFamily


def inducing_sizes(n_inducing: int | None, n_features: int, n_outputs: int) -> list[tuple[int, int]]:
    """Inducing inputs of the mean's processes and of the covariance's, to be tried one after another."""
    if n_inducing is not None:
        return [(n_inducing, n_inducing)]
    most_mean, most_covariance = (max(_FEWEST, most // n_outputs) for most in _TOGETHER)
    few = _OF_ONE if n_features == 1 else _OF_SEVERAL
    return list(dict.fromkeys((min(size, most_mean), min(size, most_covariance)) for size in (few, _MOST)))


def candidate_families(
    inputs: Float[Tensor, "n e"],
    n_distinct: int,
    sizes: list[tuple[int, int]],
    *,
    kernel: str,
    period: Float[Tensor, " e"] | None,
    length_scale: Float[Tensor, " e"] | None,
) -> list[Families]:
    """Families on as many inducing inputs as :func:`inducing_sizes` says; ``length_scale`` holds the covariance's.

    With as many as the ``n_distinct`` inputs that there were they are exact.
    """
    found = []
    for pair in sizes:
        of_mean, of_covariance = (inducing_inputs(inputs, size) for size in pair)
        mean = ProcessFamily(of_mean, *_MEAN, None, kernel, period, len(of_mean) == n_distinct)
        exact = len(of_covariance) == n_distinct
        found.append(Families(mean, ProcessFamily(of_covariance, *_LOG_VARIANCE, length_scale, kernel, period, exact)))
    return found


def check_memory(n_inducing: int | None, max_inputs: int, shape: tuple[int, int, int]) -> None:
    """Raise ValueError where a fit of ``shape``, distinct inputs, their columns and outputs, lacks memory.

    Measured: each output's features for the differences that start a search take the most, and then all outputs'
    together.
    """
    n_distinct, n_features, n_outputs = shape
    n_inputs = min(n_distinct, max_inputs)
    size = min(n_inputs, max(max(pair) for pair in inducing_sizes(n_inducing, n_features, n_outputs)))
    searched = 4 * (n_features + 1) * (n_features + 2) * n_outputs * size * (n_inputs + size)
    require_much(
        8.0 * (searched + 24 * (n_outputs * size) ** 2),
        what=f"max_inputs={max_inputs} with n_inducing={n_inducing} lets {n_inputs} distinct "
        f"inputs and {size} inducing ones into the fit, which",
        remedy="Lower them, n_inducing first.",
    )


@dataclass
class SearchOptions:
    """Options of the hyperparameter searches, and the reports of these."""

    max_iter: int = 30
    tol: float = 1e-3
    """In nats."""
    n_restarts: int = 0
    """Starts beside the best point of the grid, where no earlier search gives one."""
    callback: Callable[[Progress], None] | None = None
    """Called at the end of each turn of mean and covariance."""
    slack: float = 1.0
    """Times the tolerance, as long as better evidence is to come."""
    ends: list[tuple[int, Status]] = field(default_factory=list)
    """Iterations of each search, and what ended it."""

    def outcome(self, losses: tuple[float, ...]) -> FitReport:
        """Report of a fit with these losses, by how its searches ended."""
        status = first_failure(status for _, status in self.ends)
        return FitReport(losses[-1], losses, max(n for n, _ in self.ends), status)


@dataclass
class Search:
    """Hyperparameters of the highest evidence times prior, by BFGS: for each of b processes by itself.

    The first run takes the best points of a small grid, and the curvature there by differences; the next ones start
    where the last ended, with its curvature.
    """

    family: ProcessFamily
    n_processes: int
    """b."""
    options: SearchOptions
    """Its ``ends`` are added to."""
    held: Float[Tensor, "b q"] | None = None
    """Hyperparameters that are given, and not searched."""
    theta: Float[Tensor, "b q"] | None = None
    """Hyperparameters that the last run ended with; beside them their log evidence times prior, and its curvature."""
    value: Float[Tensor, " b"] = field(init=False)
    _inverse_hessian: Float[Tensor, "b q q"] = field(init=False)

    def run(self, evidence: Evidence) -> Float[Tensor, "b q"]:
        """Hyperparameters for this evidence."""
        if self.held is not None:
            return self.held

        def loss(theta: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
            found, gradient = evidence(theta, rows % self.n_processes)
            prior, of_prior = self.family.log_prior(theta)
            return -found - prior, -gradient() - of_prior

        if self.theta is None:
            points, values = self.on_grid(evidence)
            starts, inverse_hessian = points[values.argsort(0, descending=True)[: 1 + self.options.n_restarts]], None
        else:
            starts, inverse_hessian = self.theta[None], self._inverse_hessian
        # All starts of all processes side by side, and of each process the best end.
        points, report = minimize_batch(
            loss,
            starts.flatten(0, 1),
            max_iter=self.options.max_iter,
            tol=self.options.slack * self.options.tol,
            inverse_hessian=inverse_hessian,
        )
        shape = len(starts), self.n_processes
        losses = report.loss.reshape(shape).nan_to_num(nan=math.inf)
        best = losses.argmin(0), torch.arange(self.n_processes, device=losses.device)
        self.theta, self.value = points.unflatten(0, shape)[best], -losses[best]
        self._inverse_hessian = report.inverse_hessian.unflatten(0, shape)[best]
        self.options.ends.append((report.n_iter, report.status))
        return self.theta

    def on_grid(self, evidence: Evidence) -> tuple[Float[Tensor, "s q"], Float[Tensor, "s b"]]:
        """Hyperparameters where a search may begin, and their log evidence times prior for each process.

        Those of one length scale are tried together, as they take as many features; all, where calls cost more.
        """
        inducing, every = self.family.inducing, torch.arange(self.n_processes)
        points = inducing.new_tensor([[math.log(scale)] * inducing.shape[1] + [size] for scale, size in _STARTS])
        small = self.n_processes * len(inducing) ** 2 < _SMALL
        value = guarded(lambda theta, rows: (evidence(theta, rows)[0], theta))
        parts = [
            value(part.repeat_interleave(len(every), dim=0), every.repeat(len(part)).to(points.device))[0]
            for part in points.split(len(points) if small else 2)
        ]
        values = torch.cat(parts).reshape(len(points), -1) + self.family.log_prior(points)[0][:, None]
        return points, values.nan_to_num(nan=-math.inf)


def stretched(
    family: ProcessFamily, inputs: Float[Tensor, "n e"], squares: Squares, options: SearchOptions
) -> ProcessFamily:
    """Family with the inputs stretched at ends where the evidence for the log variances of residuals is higher so.

    By the best points of the searches' grid and, where these say so, by what searches find: the grid alone stretched
    more often, and fresh demonstrations of the tunnel were less likely by up to half a nat a step.
    """
    if inputs.shape[1] > 1 or family.period is not None or family.fixed_length_scale is not None:
        return family
    falling = [end for end in (0, 1) if _falls(squares, inputs[:, 0], end)]
    if not falling:
        return family
    # From the best point of the grid, to a tenth of a nat: what is asked is whether twenty are gained.
    options = replace(options, n_restarts=0, tol=max(options.tol, 0.1))

    def evidence(family: ProcessFamily, *, searched: bool) -> float:
        search, near = Search(family, len(squares.total), options), squares.log_pooled.clone()
        of_theta = log_variance_evidence(FixedFeatures(family, inputs), squares, near)
        if not searched:
            return float(search.on_grid(of_theta)[1].amax(0).sum())
        search.run(of_theta)
        return float(search.value.sum())

    result, on_grid, highest = family, evidence(family, searched=False), None
    unstretched, finest = inputs.new_tensor([[0.0, 1.0], [0.0, 1.0]]), spacing(inputs) / _WIDTHS[0]
    # Each end by itself, and both: where one is stretched the other still asks for a short length scale.
    for ends in ([0], [1], [0, 1]) if len(falling) > 1 else [falling]:
        tried = []
        for width in _WIDTHS:
            stretch = (unstretched if result.stretch is None else result.stretch).clone()
            stretch[ends] = inputs.new_tensor([_LENGTH, width * max(1.0, finest)])
            candidate = on_stretched_inputs(family, inputs, stretch)
            tried.append((evidence(candidate, searched=False), candidate))
        found, candidate = max(tried, key=itemgetter(0))
        if found < on_grid + _CLEARLY:
            continue
        highest = evidence(result, searched=True) if highest is None else highest
        if (now := evidence(candidate, searched=True)) > highest + _CLEARLY:
            on_grid, highest, result = found, now, candidate
    return result


def _falls(squares: Squares, x: Float[Tensor, " n"], end: int) -> bool:
    """Whether deviations of an output fall at the start (0) or the goal (1) of the range."""
    far = (x - x.min() if end == 0 else x.max() - x) / (x.max() - x.min())
    outer, inner = far <= 0.01, (far >= 0.05) & (far <= 0.15)
    variances = [squares.total[:, part].sum(1) / squares.degrees[:, part].sum(1) for part in (outer, inner)]
    return bool((variances[0] < _FALLS**2 * variances[1]).any())  # of no inputs there the quotient is not a number


def on_stretched_inputs(
    family: ProcessFamily, inputs: Float[Tensor, "n e"], stretch: Float[Tensor, "2 2"] | None
) -> ProcessFamily:
    """Family with as many inducing inputs, evenly over the stretched range."""
    family = replace(family, stretch=stretch)
    if family.exact or stretch is None:
        return family
    chosen = replace(family, inducing=inputs).farthest_first[: len(family.inducing)]
    return replace(family, inducing=inputs[chosen.sort().values])
