"""Hyperparameters of Gaussian processes by their evidence: a grid, then BFGS from its deepest valleys.

What is maximized is the evidence in length scales and noise ratio; the best amplitude is known in closed form
(:class:`~torch_pbd.gp.evidence.Evidence`). The steps, in :meth:`_Search.run`:

1. the evidence on a grid of length scales that a few nodes carry, at a cost that does not grow with the inputs
   (:class:`~torch_pbd.gp.observations.Basis`);
2. which processes may be better with shorter length scales than these;
3. for the others, BFGS from the deepest valleys of the grid;
4. for the rest, and those that BFGS led to the shortest length scale, the next grid, with more nodes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.evidence import MIN_NOISE_RATIO, Coordinates, Evidence, EvidenceSearch
from torch_pbd.gp.observations import Basis, Hyperparameters, Observations, levels_on_nodes, resolved_length_scale
from torch_pbd.optim.batch import FitReport, Status, first_failure, minimize_batch

# Entries of the matrices that are treated together: they stay near the cache, and memory is bounded.
_ENTRIES = 1 << 20

# Largest ratio of neighbouring length scales of the grid; a finer one where nodes are so few that a decomposition
# costs nearly nothing. With the coarse one alone 3 of 1200 made-up processes lost up to 0.4 nats.
_GRID_STEP, _FINE_STEP, _SMALL = 1.4, 1.25, 24

# Where the evidence is nearly flat in the ratio no optimum is lost between coarser steps.
_LOG10_RATIOS = (-10.0, -8.0, -6.0, -5.0, -4.0, *(0.25 * step for step in range(-14, 7)), 2.0, 3.0, 4.0)

# Points that a local minimum of the grid is the lowest of: of fewer, points along one valley would be several.
_AROUND = (5, 7)

# Residuals whose first autocorrelations, squared and summed, are above the 0.9999 quantile of the chi-squared
# distribution of as many degrees of freedom are no white noise.
_LAGS, _NOT_WHITE = 3, 21.1

# Nats for each input that polishing may be worth: an optimum deeper than that below its start on the grid would, on
# a line, have to be a spike. Without the bound searches take a sixth longer, and 1200 processes gained nothing.
_HOPEFUL = 0.5

# Multiplications of a decomposition for all processes below which the next level is so cheap that there is nothing to
# gain by leaving processes behind.
_FEW = 2e7

# Times the shortest length scale of a level, below which BFGS has ended at that bound.
_AT_BOUND = 1.02

Job = tuple[Observations, EvidenceSearch]


class Found(NamedTuple):
    """Hyperparameters that maximize the evidence of each process."""

    hyperparameters: Hyperparameters
    loss: Float[Tensor, " b"]
    """Negative log evidence, in nats."""
    report: FitReport
    """Report of the sum of the losses; its curve has two points, the grid's best and the end."""
    basis: Basis
    """The smallest of the search that carries the processes."""


def fit_together(jobs: Sequence[Job]) -> list[Found]:
    """What is found for each job, in one search where inputs and counts are the same.

    A search of few processes costs little more than one of many: what is common is done once, and evaluations are
    batched. Jobs that hold a length scale or a noise are searched by themselves. Where there is no start from which the
    evidence can be computed, as for a length scale held at many times the spacing of inputs without noise, it raises a
    NotPositiveDefiniteError.
    """
    first, search = jobs[0]
    held = search.length_scale is not None or search.noise_scale is not None
    alike = not held and all(
        other == replace(search, length_scale_bounds=(search.length_scale_bounds[0], other.length_scale_bounds[1]))
        and torch.equal(first.inputs, data.inputs)
        and torch.equal(first.counts, data.counts)
        for data, other in jobs
    )
    if not alike and len(jobs) > 1:
        return [fit_together([job])[0] for job in jobs]
    with torch.inference_mode():
        found = _Search(jobs)
        ends = found.run()
    # Copies, made outside of the inference mode: autograd would refuse its tensors.
    results, n_features = [], first.inputs.shape[1]
    for part in ends.clone().split([len(data.targets) for data, _ in jobs]):
        length_scale, (noise_ratio, amplitude, start_loss, loss) = part[:, :n_features], part[:, n_features:].unbind(1)
        curve = float(start_loss.sum()), float(loss.sum())
        report = FitReport(curve[-1], curve, found.n_iter, first_failure(found.statuses))
        shortest = 1.0001 * float(length_scale.min())  # a search ends at the bound but for rounding
        basis = next((basis for least, basis in found.bases if shortest >= least), found.bases[-1][1])
        hyperparameters = (tensor.clone() for tensor in (length_scale, amplitude, noise_ratio))
        results.append(Found(Hyperparameters(*hyperparameters), loss.clone(), report, basis))
    return results


class _Search:
    """Search of the processes of all jobs: the grid, of those still searched, and the ends of the others."""

    evidence: Evidence
    """Evidence in the basis of the present level."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        observations, self._options = jobs[0]
        self._noise, self._fixed = self._options.noise_scale, self._options.length_scale
        noise = self._noise
        if noise is not None and len((noise > 0).unique()) > 1:
            raise ValueError("noise_scale is zero for some processes and not for others: fit these in two searches.")
        targets = torch.cat([data.targets for data, _ in jobs])
        longest = [targets.new_full(data.targets.shape[:1], its.length_scale_bounds[1]) for data, its in jobs]
        self._observations, self._longest = replace(observations, targets=targets), torch.cat(longest)
        self._noisy = noise is None or bool((noise > 0).all())
        self._ratios = _noise_ratios(targets, noise) if self._noisy else targets.new_zeros(1)
        self._shortest = self._options.length_scale_bounds[0] if self._fixed is None else float(self._fixed.min())
        self._levels = self._resolutions()
        self._scales = targets.new_zeros(0, observations.inputs.shape[1])  # length scales of the grid
        self._table = targets.new_zeros(len(targets), 0, len(self._ratios))
        self._processes = torch.arange(len(targets), device=targets.device)  # those that are still searched
        self.bases: list[tuple[float, Basis]] = []  # shortest length scale of each level so far, and its basis
        self.n_iter, self.statuses = 0, [Status.CONVERGED]  # iterations and statuses of the descents

    def _resolutions(self) -> list[tuple[float, int | None]]:
        """Shortest length scales of the levels, the coarsest first, and their nodes; None are the inputs themselves.

        Variation that nodes do not represent is treated as noise, so there must be some.
        """
        inputs, most = self._observations.inputs, self._options.max_inputs or len(self._observations.counts)
        levels: list[tuple[float, int | None]] = [(0.0, None)]
        if self._noisy:
            merged = len(inputs) > most
            least = resolved_length_scale(Basis(self._observations, max_inputs=most).nodes) if merged else 0.0
            levels = [*levels_on_nodes(inputs, self._options.kernel, most), (least, None)]
        # Of those that carry all length scales there are, only the coarsest.
        last = next((i for i, (least, _) in enumerate(levels) if least <= self._shortest), len(levels) - 1)
        return levels[: last + 1] if self._fixed is None else [levels[last]]

    def run(self) -> Float[Tensor, "b c"]:
        """Ends of all processes: length scales, noise ratio, amplitude, loss at the start and at the end."""
        self._refine()
        n_inputs, n_features = self._observations.inputs.shape
        ends = self._table.new_zeros(len(self._processes), n_features + 4)
        while True:
            left = self._unsettled()
            if self._levels and bool(left.any()):
                n_nodes = self._levels[0][1] or min(n_inputs, self._options.max_inputs or n_inputs)
                # So cheap is the next level then that those that have settled go on to it too.
                if len(left) * n_nodes**3 <= _FEW:
                    self._refine()
                    continue
            rows = (~left).nonzero().squeeze(1)
            if len(rows):
                ends[self._processes[rows]] = found = self._descend(rows)
                if self._levels:  # the next one may take these further
                    left[rows[found[:, :n_features].amin(1) < _AT_BOUND * self.bases[-1][0]]] = True
            if not bool(left.any()):
                return ends
            # Those that have settled are left behind.
            self._observations = replace(self._observations, targets=self._observations.targets[left])
            self._noise = None if self._noise is None else self._noise[left]
            self._longest, self._table = self._longest[left], self._table[left]
            self._processes = self._processes[left]
            self._refine()

    def _refine(self) -> None:
        """Add the length scales that the next level carries to the grid."""
        carried, n_nodes = self._levels.pop(0)
        least = max(self._shortest, carried)
        longest = self.bases[-1][0] if self.bases else max(self._shortest, float(self._longest.max()))
        basis = Basis(self._observations, n_nodes, self._options.max_inputs if self._noisy else None)
        self.bases.append((least, basis))
        self.evidence = Evidence(basis, self._observations.targets, self._options.kernel, self._noise)
        if self._fixed is None:
            step = _FINE_STEP if len(basis.nodes) <= _SMALL else _GRID_STEP
            n_steps = max(0, math.ceil(math.log(longest / least) / math.log(step) - 1e-9))
            new = torch.logspace(math.log10(least), math.log10(longest), n_steps + 1, dtype=self._scales.dtype)
            new = (new[:-1] if len(self._scales) else new)[:, None].to(self._scales).expand(-1, basis.nodes.shape[1])
        else:
            new = self._fixed[None]
        parts = new.split(_together(basis))
        table = torch.cat([self.evidence.table(part, self._ratios) for part in parts], dim=1)
        if self._fixed is None:
            # A process whose bound lies between two length scales of the grid keeps the nearer one above it.
            beyond = new[:, 0] > _GRID_STEP**0.5 * self._longest[:, None]
            table = table.masked_fill(beyond.unsqueeze(-1), math.inf)
        self._scales = torch.cat([new, self._scales])
        self._table = torch.cat([table, self._table], dim=1)

    def _unsettled(self) -> Bool[Tensor, " b"]:
        """Whether length scales below those of the grid may be better, for each process.

        They may where the shortest so far is the best one, or where what a process leaves unexplained is no white
        noise.
        """
        best = self._table.flatten(1).argmin(1)
        scale, ratio = best // len(self._ratios), best % len(self._ratios)
        if not self._levels:
            return torch.zeros_like(best, dtype=torch.bool)
        residual = self.evidence.residual(self._scales[scale], self._ratios[ratio])
        residual = residual[:, self._observations.inputs[:, 0].argsort()]
        total = residual.square().sum(1).clamp_min(1e-300)
        products = [(residual[:, lag:] * residual[:, :-lag]).sum(1) / total for lag in range(1, _LAGS + 1)]
        return (scale == 0) | (residual.shape[1] * torch.stack(products).square().sum(0) > _NOT_WHITE)

    def _valleys(self) -> tuple[Tensor, Tensor, Tensor]:
        """Length scales (b, v, e), noise ratios (b, v) and loss (b, v) of the deepest local minima, in nats.

        The evidence often has one optimum where the data are signal and one where they are noise, with a plateau
        between. Where there are fewer than v the loss is infinite, and the length scale the shortest.
        """
        surrounding = -max_pool2d(-self._table, _AROUND, stride=1, padding=(_AROUND[0] // 2, _AROUND[1] // 2))
        minima = torch.where(self._table <= surrounding, self._table, math.inf).flatten(1)
        most = min(1 + self._options.n_restarts, minima.shape[1])
        loss, place = minima.topk(most, dim=1, largest=False)
        place = torch.where(loss.isfinite(), place, 0)
        return self._scales[place // len(self._ratios)], self._ratios[place % len(self._ratios)], loss

    def _descend(self, chosen: Int64[Tensor, " a"]) -> Float[Tensor, "a c"]:
        """BFGS from the deepest valleys of the chosen processes; of each the best end."""
        evidence, lowest_ratio = self.evidence, float(self._ratios[0])
        coordinates = Coordinates(evidence, self._fixed, self.bases[-1][0], self._longest, lowest_ratio)
        length_scale, noise_ratio, loss = (part[chosen] for part in self._valleys())
        # The deepest is taken in any case, even if the grid takes it for singular, by a strict rule.
        hopeful = (loss <= loss[:, :1] + _HOPEFUL * evidence.n_inputs) & loss.isfinite()
        hopeful[:, 0] = True
        number, valley = hopeful.nonzero().unbind(1)
        process = chosen[number]
        starts = coordinates.encode(length_scale[number, valley], noise_ratio[number, valley], process)
        size, first, final = _together(evidence.basis), torch.full_like(loss, math.inf), torch.full_like(loss, math.inf)
        points = torch.empty_like(starts)
        for part in torch.arange(len(starts), device=starts.device).split(size):
            points[part], report = minimize_batch(
                lambda z, index, rows=process[part]: coordinates.loss(z, rows[index]),
                starts[part],
                max_iter=self._options.max_iter,
                tol=self._options.tol,
            )
            first[number[part], valley[part]] = report.start_loss.nan_to_num(nan=math.inf)
            final[number[part], valley[part]] = report.loss.nan_to_num(nan=math.inf)
            self.n_iter = max(self.n_iter, report.n_iter)
            self.statuses.append(report.status)
        lowest, best = final.min(1)
        if not bool(lowest.isfinite().all()):
            raise NotPositiveDefiniteError(
                "The kernel matrix is singular wherever the hyperparameters were searched. Allow for noise "
                "(noise_scale=None), or give a shorter length_scale."
            )
        place = hopeful.flatten().cumsum(0).reshape(loss.shape).gather(1, best[:, None]).squeeze(1) - 1
        scale, ratio = coordinates.decode(points[place], chosen)
        amplitude = evidence.best_variance(scale, ratio, chosen).sqrt()
        others = [part[:, None] for part in (ratio, amplitude, first.amin(1), lowest)]
        return torch.cat([scale, *others], dim=1)


def _noise_ratios(targets: Float[Tensor, "b n"], noise_scale: Tensor | None) -> Tensor:
    """Noise ratios of the grid; a fixed noise must leave room for amplitudes a hundred times the targets."""
    ratios = 10.0 ** targets.new_tensor(_LOG10_RATIOS)
    if noise_scale is None:
        return ratios
    largest = float(targets.square().mean(1).max())
    lowest = max(float(noise_scale.min()) ** 2 / max(1e4 * largest, 1e-200), 1e-40)
    lower = range(math.ceil(math.log10(lowest)), int(_LOG10_RATIOS[0]))
    below = [lowest] * (lowest < 0.999 * MIN_NOISE_RATIO) + [10.0**exponent for exponent in lower]
    return torch.cat([ratios.new_tensor(sorted(set(below))), ratios])


def _together(basis: Basis) -> int:
    """Number of covariances treated at a time."""
    return max(1, _ENTRIES // len(basis.nodes) ** 2)
