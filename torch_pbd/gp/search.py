"""Hyperparameters of Gaussian processes by their evidence: a grid, then BFGS from its deepest valleys.

What is maximized is the evidence in length scales and noise ratio; the best amplitude is known in closed form
(:mod:`~torch_pbd.gp.latent`). The steps, in :func:`_maximize`:

1. the evidence on a grid of length scales that a few nodes carry, at a cost that does not grow with the inputs
   (:mod:`~torch_pbd.gp.observations`);
2. which processes may be better with shorter length scales than these (:meth:`EvidenceGrid.unsettled`);
3. for the others, BFGS from the deepest valleys of the grid;
4. for the rest, and those that BFGS led to the shortest length scale, the next grid, with more nodes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.grid import EvidenceGrid, EvidenceSearch, together
from torch_pbd.gp.observations import Basis, Hyperparameters, Observations
from torch_pbd.optim import FitReport, Status, first_failure, minimize_batch

# Nats for each input that polishing may be worth: an optimum deeper than that below its start on the grid would, on
# a line, have to be a spike. Without the bound searches take a sixth longer, and 1200 processes gained nothing.
_HOPEFUL = 0.5

# Multiplications of a decomposition for all processes below which the next level is so cheap that there is nothing to
# gain by leaving processes behind.
_FEW = 2e7

# Times the shortest length scale of a level, below which BFGS has ended at that bound.
_AT_BOUND = 1.02


def fit_hyperparameters(
    observations: Observations, search: EvidenceSearch
) -> tuple[Hyperparameters, Float[Tensor, " b"], FitReport]:
    """Hyperparameters that maximize each process's evidence: a grid, then BFGS from its deepest valleys.

    Returns
    -------
    Hyperparameters
    loss : Tensor of shape (b,)
        Negative log evidence of each process, in nats.
    report : FitReport
        Of their sum; its curve has two points, the grid's best and the end.

    Raises
    ------
    ValueError
        If the noise is held at zero for some processes and above zero for others.
    NotPositiveDefiniteError
        If there is no start from which the evidence can be computed, as for a length scale held at many
        times the spacing of inputs without noise.
    """
    return fit_together([(observations, search)])[0][:3]


class Found(NamedTuple):
    """Result of a search."""

    hyperparameters: Hyperparameters
    loss: Float[Tensor, " b"]
    """Negative log evidence, in nats."""
    report: FitReport
    basis: Basis
    """The smallest of the search that carries the processes."""


def fit_together(jobs: Sequence[tuple[Observations, EvidenceSearch]]) -> list[Found]:
    """Results of :func:`fit_hyperparameters` for each job, in one search where inputs and counts are the same.

    A search of few processes costs little more than one of many: what is common is done once, and evaluations are
    batched. Jobs that hold a length scale or a noise are searched by themselves.
    """
    alike = all(_searchable_together(jobs[0], job) for job in jobs)
    groups = [list(jobs)] if alike else [[job] for job in jobs]
    return [result for group in groups for result in _fit_group(group)]


def _searchable_together(job: tuple[Observations, EvidenceSearch], other: tuple[Observations, EvidenceSearch]) -> bool:
    (data, search), (its_data, its_search) = job, other
    bounds = (search.length_scale_bounds[0], its_search.length_scale_bounds[1])
    return (
        search.length_scale is None
        and search.noise_scale is None
        and its_search == replace(search, length_scale_bounds=bounds)
        and torch.equal(data.inputs, its_data.inputs)
        and torch.equal(data.counts, its_data.counts)
    )


def _fit_group(jobs: list[tuple[Observations, EvidenceSearch]]) -> list[Found]:
    search = jobs[0][1]
    if search.noise_scale is not None and len((search.noise_scale > 0).unique()) > 1:
        raise ValueError("noise_scale is zero for some processes and not for others: fit these in two searches.")
    with torch.inference_mode():
        targets = torch.cat([data.targets for data, _ in jobs])
        longest = torch.cat([its.length_scale_bounds[1] * torch.ones_like(data.targets[:, 0]) for data, its in jobs])
        grid = EvidenceGrid(replace(jobs[0][0], targets=targets), search, longest)
        ends = _maximize(grid, search)
    # Copies, made outside of the inference mode: autograd would refuse its tensors.
    sizes = [len(data.targets) for data, _ in jobs]
    parts = (part.clone().split(sizes) for part in (ends.length_scale, ends.amplitude, ends.noise_ratio))
    results = []
    for *each, first, loss in zip(*parts, ends.start_loss.split(sizes), ends.loss.clone().split(sizes), strict=True):
        curve = (float(first.sum()), float(loss.sum()))
        report = FitReport(curve[-1], curve, ends.n_iter, ends.status)
        shortest = 1.0001 * float(each[0].min())  # a search ends at the bound but for rounding
        basis = next((basis for least, basis in grid.bases if shortest >= least), grid.bases[-1][1])
        results.append(Found(Hyperparameters(*each), loss, report, basis))
    return results


@dataclass
class _Ends:
    """Ends of the descents of processes."""

    length_scale: Float[Tensor, "b e"]
    noise_ratio: Float[Tensor, " b"]
    amplitude: Float[Tensor, " b"]
    start_loss: Float[Tensor, " b"]
    loss: Float[Tensor, " b"]
    n_iter: int = 0
    status: Status = Status.CONVERGED

    def put(self, rows: Tensor, other: "_Ends") -> None:
        """Take the ends of some processes."""
        for name in ("length_scale", "noise_ratio", "amplitude", "start_loss", "loss"):
            getattr(self, name)[rows] = getattr(other, name)
        self.n_iter = max(self.n_iter, other.n_iter)
        self.status = first_failure((self.status, other.status))


def _maximize(grid: EvidenceGrid, search: EvidenceSearch) -> _Ends:
    """Steps 1 to 4 of this module, until all processes have ended."""
    grid.refine()
    blank = torch.zeros(4, len(grid.processes)).to(grid.evidence.targets)
    ends = _Ends(
        blank[0][:, None].repeat(1, grid.evidence.basis.nodes.shape[1]), blank[0], blank[1], blank[2], blank[3]
    )
    while True:
        left, level = grid.unsettled(), grid.next_level
        if level is not None and bool(left.any()):
            n_nodes = level.n_nodes or level.max_inputs or grid.evidence.n_inputs
            # So cheap is the next level then that those that have settled go on to it too.
            if len(left) * n_nodes**3 <= _FEW:
                grid.refine()
                continue
        rows = (~left).nonzero().squeeze(1)
        if len(rows):
            found = _descend(grid, search, rows)
            ends.put(grid.processes[rows], found)
            if level is not None:  # the next one may take these further
                left[rows[found.length_scale.amin(1) < _AT_BOUND * grid.shortest]] = True
        if not bool(left.any()):
            return ends
        grid.keep(left)
        grid.refine()


def _descend(grid: EvidenceGrid, search: EvidenceSearch, chosen: Int64[Tensor, " a"]) -> _Ends:
    """BFGS from the deepest valleys of some of a grid's processes; of each the best end."""
    evidence, coordinates = grid.evidence, grid.coordinates()
    length_scale, noise_ratio, loss = (part[chosen] for part in grid.valleys(1 + search.n_restarts))
    # The deepest is taken in any case, even if the grid takes it for singular, by a strict rule.
    hopeful = (loss <= loss[:, :1] + _HOPEFUL * evidence.n_inputs) & loss.isfinite()
    hopeful[:, 0] = True
    number, valley = hopeful.nonzero().unbind(1)
    process = chosen[number]
    starts = coordinates.encode(length_scale[number, valley], noise_ratio[number, valley], process)
    size, points, reports = together(evidence.basis), [], []
    for part, rows in zip(starts.split(size), process.split(size), strict=True):
        point, report = minimize_batch(
            lambda z, index, rows=rows: coordinates.loss(z, rows[index]), part, max_iter=search.max_iter, tol=search.tol
        )
        points.append(point)
        reports.append(report)
    never = torch.full_like(loss, math.inf)
    first, final = (
        never.index_put((number, valley), torch.cat(values).nan_to_num(nan=math.inf))
        for values in zip(*((report.start_loss, report.loss) for report in reports), strict=True)
    )
    lowest, best = final.min(1)
    if not bool(lowest.isfinite().all()):
        raise NotPositiveDefiniteError(
            "The kernel matrix is singular wherever the hyperparameters were searched. Allow for noise "
            "(noise_scale=None), or give a shorter length_scale."
        )
    place = torch.zeros_like(loss, dtype=torch.long)
    place[number, valley] = torch.arange(len(number), device=loss.device)
    scale, ratio = coordinates.decode(torch.cat(points)[place.gather(1, best[:, None]).squeeze(1)], chosen)
    amplitude = evidence.best_variance(scale, ratio, chosen).sqrt()
    n_iter, status = max(report.n_iter for report in reports), first_failure(report.status for report in reports)
    return _Ends(scale, ratio, amplitude, first.amin(1), lowest, n_iter, status)
