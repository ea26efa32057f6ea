"""Many small unrelated optimizations side by side."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_LONGEST_STEP = 1e3  # in steps of L-BFGS


@dataclass(frozen=True)
class BatchReport:
    """How the optimizations of a batch ended, each for itself."""

    loss: Float[Tensor, " b"]
    n_iter: int
    converged: bool
    """All of them."""


def minimize_batch(
    objective: Callable[[Float[Tensor, "a p"], Int64[Tensor, " a"]], Float[Tensor, " a"]],
    start: Float[Tensor, "b p"],
    *,
    max_iter: int = 100,
    tol: float = 1e-6,
    history_size: int = 10,
) -> tuple[Float[Tensor, "b p"], BatchReport]:
    """Minimize b unrelated objectives of p parameters by L-BFGS, their evaluations in one batch.

    Each problem has its own curvature pairs, its own step and its own end: a joint L-BFGS over all of them
    would share one line search and one memory between problems that have nothing to do with each other.
    Steps are accepted by the Armijo rule, so the loss never rises; a value that is not finite counts as
    too far. Where the slope along a step has hardly changed, the next step starts four times as long.

    Parameters
    ----------
    objective : callable
        Given parameters of a problems and their indices in the batch, returns their a losses.
    start : Tensor of shape (b, p)
        Where to start. A problem whose loss there is not finite stays there.
    max_iter, tol, history_size
        As in :func:`minimize`.

    Returns
    -------
    parameters : Tensor of shape (b, p)
    report : BatchReport
    """
    x = start.detach().clone()
    rows = torch.arange(len(x), device=x.device)
    loss, gradient = _value_and_gradient(objective, x, rows)
    memory = _CurvatureMemory(history_size)
    active = torch.isfinite(loss) & torch.isfinite(gradient).all(-1) & (gradient.abs().amax(-1) > tol)
    first_step = 1.0 / gradient.norm(dim=-1).clamp_min(1.0)
    n_iter = 0
    while n_iter < max_iter and bool(active.any()):
        n_iter += 1
        direction = memory.direction(gradient)
        slope = (direction * gradient).sum(-1)
        uphill = ~(slope < 0)
        direction = torch.where(uphill[:, None], -gradient, direction)
        slope = torch.where(uphill, -gradient.square().sum(-1), slope)
        new_x, new_loss, new_gradient = _backtrack(objective, x, loss, gradient, direction, slope, first_step, active)
        memory.add(new_x - x, new_gradient - gradient)
        still_steep = (direction * new_gradient).sum(-1) < 0.9 * slope
        short = active & still_steep & (new_loss < loss) & (first_step < _LONGEST_STEP)
        first_step = torch.where(short & (n_iter > 1), 4.0 * first_step, torch.ones_like(first_step))
        gain = loss - new_loss
        x, loss, gradient = new_x, new_loss, new_gradient
        settled = (gain <= tol * 1e-2 * loss.abs().clamp_min(1.0)) & ~short
        active = active & (gradient.abs().amax(-1) > tol) & ~settled
    return x, BatchReport(loss, n_iter, not bool(active.any()))


class _CurvatureMemory:
    """Pairs of steps and gradient changes, for each problem of a batch; the two-loop recursion on them."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._pairs: list[tuple[Tensor, Tensor, Tensor]] = []

    def add(self, step: Tensor, change: Tensor) -> None:
        curvature = (step * change).sum(-1)
        usable = curvature > 1e-10 * step.norm(dim=-1) * change.norm(dim=-1)
        inverse = torch.where(usable, 1.0 / curvature.where(usable, torch.ones_like(curvature)), 0.0)
        self._pairs = [*self._pairs, (step, change, inverse)][-self._size :]

    def direction(self, gradient: Tensor) -> Tensor:
        vector = -gradient
        scale = torch.ones_like(gradient[:, 0])
        projections = []
        for step, change, inverse in reversed(self._pairs):
            projection = inverse * (step * vector).sum(-1)
            vector = vector - projection[:, None] * change
            projections.append(projection)
        for step, change, inverse in self._pairs:
            fitted = (step * change).sum(-1) / change.square().sum(-1).clamp_min(1e-300)
            scale = torch.where(inverse > 0, fitted, scale)
        vector = scale[:, None] * vector
        for (step, change, inverse), projection in zip(self._pairs, reversed(projections), strict=True):
            vector = vector + (projection - inverse * (change * vector).sum(-1))[:, None] * step
        return vector


def _value_and_gradient(
    objective: Callable[[Tensor, Tensor], Tensor], x: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        leaf = x.detach().requires_grad_()
        loss = objective(leaf, rows)
        (gradient,) = torch.autograd.grad(loss.sum(), leaf)
    return loss.detach(), gradient


def _backtrack(
    objective: Callable[[Tensor, Tensor], Tensor],
    x: Tensor,
    loss: Tensor,
    gradient: Tensor,
    direction: Tensor,
    slope: Tensor,
    step: Tensor,
    active: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Shorten each active problem's step until its loss falls enough; the others stay where they are."""
    new_x, new_loss, new_gradient = x.clone(), loss.clone(), gradient.clone()
    rows = active.nonzero().squeeze(-1)
    for _ in range(25):
        if len(rows) == 0:
            break
        trial = x[rows] + step[rows, None] * direction[rows]
        value, trial_gradient = _value_and_gradient(objective, trial, rows)
        finite = torch.isfinite(value) & torch.isfinite(trial_gradient).all(-1)
        accepted = finite & (value <= loss[rows] + 1e-4 * step[rows] * slope[rows])
        done = rows[accepted]
        new_x[done], new_loss[done], new_gradient[done] = (
            trial[accepted],
            value[accepted],
            trial_gradient[accepted],
        )
        # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
        parabola = -0.5 * step[rows] * slope[rows] / ((value - loss[rows]) / step[rows] - slope[rows])
        shorter = torch.where(finite, parabola, 0.1 * step[rows])
        step = step.index_copy(0, rows, shorter.clamp(0.1 * step[rows], 0.5 * step[rows]))
        rows = rows[~accepted]
    return new_x, new_loss, new_gradient
