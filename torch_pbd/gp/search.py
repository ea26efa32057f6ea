"""Hyperparameters of Gaussian processes by their evidence: a grid, then BFGS from its deepest valleys."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.gp.grid import EvidenceGrid, EvidenceSearch, together
from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.gp.projection import Basis
from torch_pbd.optim import BatchReport, FitReport, minimize_batch

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
    """Carries the processes."""


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
    sizes = [len(data.targets) for data, _ in jobs]
    with torch.inference_mode():
        targets = torch.cat([data.targets for data, _ in jobs])
        longest = torch.cat([its.length_scale_bounds[1] * torch.ones_like(data.targets[:, 0]) for data, its in jobs])
        grid = EvidenceGrid(replace(jobs[0][0], targets=targets), search, longest)
        while True:
            length_scale, noise_ratio, end = _descend(grid, search)
            if grid.finest or bool((length_scale > 1.02 * grid.shortest).all()):
                break
            grid.refine()  # a process ends where its level does: the next one may take it further
        amplitude = grid.evidence.best_variance_at(length_scale, noise_ratio).sqrt()
    message = "converged" if end.converged else f"stopped at max_iter={search.max_iter} iterations"
    results = []
    # Copies, made outside of the inference mode: autograd would refuse its tensors.
    for parts in zip(
        *(part.split(sizes) for part in (length_scale, amplitude, noise_ratio, end.start_loss, end.loss)), strict=True
    ):
        scale, size, ratio, first, loss = (part.clone() for part in parts)
        curve = (float(first.sum()), float(loss.sum()))
        report = FitReport(curve[-1], curve, end.n_iter, end.converged, message)
        results.append(Found(Hyperparameters(scale, size, ratio), loss, report, grid.evidence.projection.basis))
    return results


def _descend(grid: EvidenceGrid, search: EvidenceSearch) -> tuple[Tensor, Tensor, BatchReport]:
    """Length scales (b, e), noise ratios (b,), and how the descents ended."""
    coordinates = grid.coordinates()
    n_inputs = grid.evidence.projection.n_inputs
    length_scale, noise_ratio, loss = grid.valleys(1 + search.n_restarts)
    # A start far worse than another for each input is not polished: its optimum would have to be a spike. One that the
    # grid takes for singular, by a strict rule, is tried where there is no other.
    hopeful = (loss <= loss[:, :1] + _HOPEFUL * n_inputs) & loss.isfinite()
    hopeful[:, 0] = True
    process, valley = hopeful.nonzero().unbind(1)
    starts = coordinates.encode(length_scale[process, valley], noise_ratio[process, valley], process)
    ends, reports = [], []
    size = together(grid.evidence.projection)
    for part, rows in zip(starts.split(size), process.split(size), strict=True):
        end, report = minimize_batch(
            lambda z, index, rows=rows: coordinates.loss(z, rows[index]), part, max_iter=search.max_iter, tol=search.tol
        )
        ends.append(end)
        reports.append(report)
    first, final = (
        torch.full_like(loss, math.inf).index_put((process, valley), torch.cat(values).nan_to_num(nan=math.inf))
        for values in zip(*((report.start_loss, report.loss) for report in reports), strict=True)
    )
    if not bool(torch.isfinite(final.amin(1)).all()):
        raise NotPositiveDefiniteError(
            "The kernel matrix is singular wherever the hyperparameters were searched. Allow for noise "
            "(noise_scale=None), or give a shorter length_scale."
        )
    place = torch.zeros_like(loss, dtype=torch.long)
    place[process, valley] = torch.arange(len(process), device=loss.device)
    best = final.argmin(1, keepdim=True)
    every = torch.arange(len(loss), device=loss.device)
    found = coordinates.decode(torch.cat(ends)[place.gather(1, best).squeeze(1)], every)
    n_iter = max(report.n_iter for report in reports)
    converged = all(report.converged for report in reports)
    return *found, BatchReport(final.gather(1, best).squeeze(1), first.amin(1), n_iter, converged)
