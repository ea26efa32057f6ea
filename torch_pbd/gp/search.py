"""Hyperparameters of Gaussian processes by their evidence: a grid, then BFGS from its deepest valleys."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.grid import EvidenceGrid, EvidenceSearch, together
from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.gp.projection import Basis
from torch_pbd.optim import FitReport, Status, first_failure, minimize_batch

_HOPEFUL = 0.5  # nats for each input that polishing may be worth


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
    """What a search found."""

    hyperparameters: Hyperparameters
    loss: Float[Tensor, " b"]
    """Negative log evidence, in nats."""
    report: FitReport
    basis: Basis
    """The smallest of the search that carries the processes."""


def fit_together(jobs: Sequence[tuple[Observations, EvidenceSearch]]) -> list[Found]:
    """What :func:`fit_hyperparameters` finds for each job, in one search where inputs and counts are the same.

    A search of few processes costs little more than one of many: what is common is done once, and evaluations are
    batched. Jobs that hold a length scale or a noise are searched by themselves.
    """
    alike = all(_searchable_together(jobs[0], job) for job in jobs)
    groups = [list(jobs)] if alike else [[job] for job in jobs]
    return [result for group in groups for result in _fit_group(group)]


def _searchable_together(job: tuple[Observations, EvidenceSearch], other: tuple[Observations, EvidenceSearch]) -> bool:
    (data, search), (its_data, its_search) = job, other
    free = search.length_scale is None and search.noise_scale is None
    bounds = (search.length_scale_bounds[0], its_search.length_scale_bounds[1])
    return (
        free
        and replace(its_search, length_scale_bounds=bounds) == replace(search, length_scale_bounds=bounds)
        and its_search.length_scale_bounds[0] == search.length_scale_bounds[0]
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
        ends = _descend_by_levels(grid, search)
    # Copies, made outside of the inference mode: autograd would refuse its tensors.
    sizes = [len(data.targets) for data, _ in jobs]
    parts = (part.clone().split(sizes) for part in (ends.length_scale, ends.amplitude, ends.noise_ratio))
    results = []
    for *each, first, loss in zip(*parts, ends.start_loss.split(sizes), ends.loss.clone().split(sizes), strict=True):
        curve = (float(first.sum()), float(loss.sum()))
        report = FitReport(curve[-1], curve, ends.n_iter, ends.status)
        results.append(Found(Hyperparameters(*each), loss, report, grid.basis_for(each[0])))
    return results


@dataclass
class _Ends:
    """Where the descents of processes ended."""

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


def _descend_by_levels(grid: EvidenceGrid, search: EvidenceSearch) -> _Ends:
    """A process stays at the first level that suffices for it, unless the next is so cheap that all may go on."""
    blank = torch.zeros(len(grid.processes)).to(grid.evidence.projection.targets)
    scales = blank[:, None].repeat(1, grid.evidence.projection.basis.nodes.shape[1])
    ends = _Ends(scales, blank.clone(), blank.clone(), blank.clone(), blank.clone())
    while True:
        left = grid.unsettled()
        if not bool(left.any()) or not grid.few:
            rows = (~left).nonzero().squeeze(1)
            if len(rows):
                found = _descend(grid, search, rows)
                ends.put(grid.processes[rows], found)
                if not grid.finest:  # a process that ends where its level does may be taken further by the next one
                    left[rows[found.length_scale.amin(1) < 1.02 * grid.shortest]] = True
            if not bool(left.any()):
                return ends
            grid.keep(left)
        grid.refine()


def _descend(grid: EvidenceGrid, search: EvidenceSearch, chosen: Int64[Tensor, " a"]) -> _Ends:
    """Polish the deepest valleys of some of a grid's processes."""
    coordinates, n_inputs = grid.coordinates(), grid.evidence.projection.n_inputs
    length_scale, noise_ratio, loss = (part[chosen] for part in grid.valleys(1 + search.n_restarts))
    # A start far worse than another for each input is not polished: its optimum would have to be a spike. One that the
    # grid takes for singular, by a strict rule, is tried where there is no other.
    hopeful = (loss <= loss[:, :1] + _HOPEFUL * n_inputs) & loss.isfinite()
    hopeful[:, 0] = True
    number, valley = hopeful.nonzero().unbind(1)
    process = chosen[number]
    starts = coordinates.encode(length_scale[number, valley], noise_ratio[number, valley], process)
    size, found, reports = together(grid.evidence.projection), [], []
    for part, rows in zip(starts.split(size), process.split(size), strict=True):
        end, report = minimize_batch(
            lambda z, index, rows=rows: coordinates.loss(z, rows[index]), part, max_iter=search.max_iter, tol=search.tol
        )
        found.append(end)
        reports.append(report)
    never = torch.full_like(loss, math.inf)
    first, final = (
        never.index_put((number, valley), torch.cat(values).nan_to_num(nan=math.inf))
        for values in zip(*((report.start_loss, report.loss) for report in reports), strict=True)
    )
    if not bool(torch.isfinite(final.amin(1)).all()):
        raise NotPositiveDefiniteError(
            "The kernel matrix is singular wherever the hyperparameters were searched. Allow for noise "
            "(noise_scale=None), or give a shorter length_scale."
        )
    place = torch.zeros_like(loss, dtype=torch.long)
    place[number, valley] = torch.arange(len(number), device=loss.device)
    best = final.argmin(1, keepdim=True)
    scale, ratio = coordinates.decode(torch.cat(found)[place.gather(1, best).squeeze(1)], chosen)
    amplitude = grid.evidence.best_variance_at(scale, ratio, chosen).sqrt()
    n_iter, status = max(report.n_iter for report in reports), first_failure(report.status for report in reports)
    return _Ends(scale, ratio, amplitude, first.amin(1), final.gather(1, best).squeeze(1), n_iter, status)
