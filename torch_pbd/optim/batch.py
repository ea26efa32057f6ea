"""Many small unrelated optimizations side by side."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_LONGEST_STEP = 1e3  # in steps of BFGS

Objective = Callable[[Tensor, Tensor], Tensor]
ObjectiveWithGradient = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class BatchReport:
    """How the optimizations of a batch ended, each for itself."""

    loss: Float[Tensor, " b"]
    n_iter: int
    converged: bool
    """All of them."""
    inverse_hessian: Float[Tensor, "b p p"]
    """At the ends, as far as the steps told."""


def minimize_batch(
    objective: Objective,
    start: Float[Tensor, "b p"],
    *,
    max_iter: int = 100,
    tol: float = 1e-6,
) -> tuple[Float[Tensor, "b p"], BatchReport]:
    """Minimize b unrelated objectives of p parameters by BFGS, their evaluations in one batch.

    As :func:`minimize_batch_with_gradient`, by autograd.

    Parameters
    ----------
    objective : callable
        Given parameters of a problems and their indices in the batch, returns their a losses.
    """

    def with_gradient(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = x.requires_grad_()
            loss = objective(leaf, rows)
            (gradient,) = torch.autograd.grad(loss.sum(), leaf)
        return loss.detach(), gradient

    return minimize_batch_with_gradient(with_gradient, start, max_iter=max_iter, tol=tol)


@torch.no_grad()
def minimize_batch_with_gradient(
    objective: ObjectiveWithGradient,
    start: Float[Tensor, "b p"],
    *,
    max_iter: int = 100,
    tol: float = 1e-6,
    inverse_hessian: Float[Tensor, "b p p"] | None = None,
) -> tuple[Float[Tensor, "b p"], BatchReport]:
    """Minimize b unrelated objectives of p parameters by BFGS, their evaluations in one batch.

    Each problem has its own inverse Hessian, its own step and its own end: a joint BFGS over all of them would
    share one line search and one curvature between problems that have nothing to do with each other. The
    matrices are p by p each, which is meant for few parameters.
    Steps are accepted by the Armijo rule, so the loss never rises; a value that is not finite counts as
    too far. Where the slope along a step has hardly changed, the next step starts four times as long.

    Parameters
    ----------
    objective : callable
        Given parameters of a problems (a, p) and their indices in the batch (a,), returns their losses (a,) and
        gradients (a, p).
    start : Tensor of shape (b, p)
        Where to start. A problem whose loss there is not finite stays there.
    max_iter, tol
        As in :func:`minimize`.
    inverse_hessian : Tensor of shape (b, p, p), default=None
        At the start, positive definite. With it a problem ends where Newton's step promises no more
        than a hundredth of ``tol``, instead of where a step has gained that share of the loss.

    Returns
    -------
    parameters : Tensor of shape (b, p)
    report : BatchReport
    """
    x = start.detach().clone()
    rows = torch.arange(len(x), device=x.device)
    loss, gradient = objective(x.clone(), rows)
    known = inverse_hessian is not None
    curvature = torch.eye(x.shape[1]).to(x).repeat(len(x), 1, 1) if inverse_hessian is None else inverse_hessian
    direction, slope = _newton(curvature, gradient)
    active = torch.isfinite(loss) & torch.isfinite(gradient).all(-1) & (gradient.abs().amax(-1) > tol)
    active = active & (slope < -2e-2 * tol) if known else active
    first_step = 1.0 / direction.norm(dim=-1).clamp_min(1.0)
    n_iter = 0
    while n_iter < max_iter and bool(active.any()):
        n_iter += 1
        uphill = ~(slope < 0)
        if bool(uphill.any()):
            direction = torch.where(uphill[:, None], -gradient, direction)
            slope = torch.where(uphill, -gradient.square().sum(-1), slope)
        new_x, new_loss, new_gradient = _backtrack(objective, x, loss, gradient, direction, slope, first_step, active)
        curvature = _updated(curvature, new_x - x, new_gradient - gradient, scaled=n_iter == 1 and not known)
        gain = loss - new_loss
        still_steep = (direction * new_gradient).sum(-1) < 0.9 * slope
        short = active & still_steep & (gain > 0) & (first_step < _LONGEST_STEP)
        first_step = torch.where(short & (n_iter > 1), 4.0 * first_step, 1.0)
        x, loss, gradient = new_x, new_loss, new_gradient
        direction, slope = _newton(curvature, gradient)
        stalled = (gain <= tol * 1e-2 * loss.abs().clamp_min(1.0)) & ~short
        settled = (slope >= -2e-2 * tol) | (gain <= 1e-14 * loss.abs()) if known else stalled
        active = active & (gradient.abs().amax(-1) > tol) & ~settled
    return x, BatchReport(loss, n_iter, not bool(active.any()), curvature)


def _newton(inverse_hessian: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Newton's step, and the slope along it: minus twice what it promises."""
    direction = -(inverse_hessian @ gradient.unsqueeze(-1)).squeeze(-1)
    return direction, (direction * gradient).sum(-1)


def _updated(
    inverse_hessian: Float[Tensor, "b p p"], step: Float[Tensor, "b p"], change: Float[Tensor, "b p"], *, scaled: bool
) -> Float[Tensor, "b p p"]:
    """Inverse Hessians that map the changes of the gradients to the steps (Nocedal and Wright, eq. (6.17)).

    Those of the start are ``scaled`` to the curvature along the first step (their eq. (6.20)).
    """
    curvature = (step * change).sum(-1)
    length = change.norm(dim=-1)
    usable = curvature > 1e-10 * step.norm(dim=-1) * length
    curvature = curvature.where(usable, 1.0)
    if scaled:
        scale = torch.where(usable, curvature / length.square().where(usable, 1.0), 1.0)
        inverse_hessian = scale[:, None, None] * inverse_hessian
    mapped = (inverse_hessian @ change.unsqueeze(-1)).squeeze(-1)
    along = (1.0 + (change * mapped).sum(-1) / curvature)[:, None] * step - mapped
    correction = along.unsqueeze(2) * step.unsqueeze(1) - step.unsqueeze(2) * mapped.unsqueeze(1)
    return inverse_hessian + (usable / curvature)[:, None, None] * correction


def _backtrack(
    objective: ObjectiveWithGradient,
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
        share = step[rows]
        trial = x[rows] + share[:, None] * direction[rows]
        value, trial_gradient = objective(trial.clone(), rows)
        finite = torch.isfinite(value) & torch.isfinite(trial_gradient).all(-1)
        accepted = finite & (value <= loss[rows] + 1e-4 * share * slope[rows])
        done = rows[accepted]
        new_x[done], new_loss[done], new_gradient[done] = trial[accepted], value[accepted], trial_gradient[accepted]
        if len(done) == len(rows):
            break
        # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
        parabola = -0.5 * share * slope[rows] / ((value - loss[rows]) / share - slope[rows])
        shorter = torch.where(finite, parabola, 0.1 * share).clamp(0.1 * share, 0.5 * share)
        step = step.index_copy(0, rows, shorter)
        rows = rows[~accepted]
    return new_x, new_loss, new_gradient
