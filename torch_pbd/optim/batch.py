"""Many small unrelated optimizations side by side."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_LONGEST_STEP = 1e3  # in steps of BFGS
_DIFFERENCE = 1e-4  # of parameters, for the first Hessian
_LEAST_CURVATURE = 1e-3  # of a Hessian's largest: a flatter direction gets no longer step
_FIRST_REACH = 1.0  # of the first step, in any parameter

ValueAndGradient = Callable[
    [Float[Tensor, "a p"], Int64[Tensor, " a"]], tuple[Float[Tensor, " a"], Float[Tensor, "a p"]]
]


@dataclass(frozen=True)
class BatchReport:
    """How the optimizations of a batch ended, each for itself."""

    loss: Float[Tensor, " b"]
    start_loss: Float[Tensor, " b"]
    n_iter: int
    converged: bool
    """All of them."""


def by_autograd(
    objective: Callable[[Float[Tensor, "a p"], Int64[Tensor, " a"]], Float[Tensor, " a"]],
) -> ValueAndGradient:
    """Value and gradient of losses (a,) of unrelated problems."""

    def value_and_gradient(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            loss = objective(leaf, rows)
            (gradient,) = torch.autograd.grad(loss.sum(), leaf)
        return loss.detach(), gradient

    return value_and_gradient


def minimize_batch(
    objective: ValueAndGradient,
    start: Float[Tensor, "b p"],
    *,
    max_iter: int = 100,
    tol: float = 1e-6,
) -> tuple[Float[Tensor, "b p"], BatchReport]:
    """Minimize b unrelated objectives of few parameters by BFGS, their evaluations in one batch.

    Each problem has its own inverse Hessian, its own step and its own end: a joint L-BFGS over all of them
    would share one line search and one memory between problems that have nothing to do with each other, and with a
    handful of parameters the whole matrix costs less than a limited memory of it. The first Hessian is found by
    differences of the gradient, in one batch too, with the absolute values of its eigenvalues. Parameters are
    expected to be of order one.
    Steps are accepted by the Armijo rule, so the loss never rises; a value that is not finite counts as
    too far. Where the slope along a step has not fallen, which tells no Hessian, the next step starts four times as
    long.

    Parameters
    ----------
    objective : callable
        Given parameters (a, p) of a problems and their indices in the batch, returns their losses (a,) and
        gradients (a, p); see :func:`by_autograd`.
    start : Tensor of shape (b, p)
        Where to start. A problem whose loss there is not finite stays there.
    max_iter : int, default=100
        Largest number of iterations.
    tol : float, default=1e-6
        A problem ends when its gradient, summed over its absolute entries, is below it, or when its last step
        gained and its next promises less than a hundredth of it.

    Returns
    -------
    parameters : Tensor of shape (b, p)
    report : BatchReport
    """
    x = start.detach().clone()
    rows = torch.arange(len(x), device=x.device)
    loss, gradient = objective(x, rows)
    ended_x, ended_loss, first_loss = x.clone(), loss.clone(), loss
    size = gradient.abs().sum(-1)  # of no parameters it is zero, and there is nothing to do
    alive = torch.isfinite(loss + size) & (size > tol)
    # Problems that have ended are not carried along: ``rows`` are those still active.
    rows, x, loss, gradient = rows[alive], x[alive], loss[alive], gradient[alive]
    inverse = _first_inverse(objective, rows, x, gradient)
    downhill = inverse @ gradient.unsqueeze(-1)  # the step, but for its sign
    decrement = (gradient * downhill.squeeze(-1)).sum(-1)
    step, n_iter = torch.ones_like(loss), 0
    while n_iter < max_iter and len(rows):
        n_iter += 1
        new_x, new_loss, new_gradient = _backtrack(
            objective, rows, x, loss, gradient, downhill.squeeze(-1), decrement, step
        )
        change = (new_gradient - gradient).unsqueeze(-1)
        # Where the slope along a step has not fallen the curvature is not that of a minimum.
        convex = (change * downhill).sum((-2, -1)) < -1e-3 * decrement
        inverse = _updated(inverse, (new_x - x).unsqueeze(-1), change, convex)
        gain = loss - new_loss
        short = ~convex & (gain > 0) & (step < _LONGEST_STEP)
        step = torch.where(short & (n_iter > 1), 4.0 * step, 1.0)
        x, loss, gradient = new_x, new_loss, new_gradient
        downhill = inverse @ gradient.unsqueeze(-1)
        decrement = (gradient * downhill.squeeze(-1)).sum(-1)
        enough = 1e-2 * tol + torch.finfo(loss.dtype).eps * loss.abs()
        ended = ((gain <= enough) & (0.5 * decrement <= enough) & ~short) | (gradient.abs().sum(-1) <= tol)
        if bool(ended.any()) or n_iter == max_iter:
            ended_x[rows], ended_loss[rows] = x, loss
            state = (rows, x, loss, gradient, inverse, downhill, decrement, step)
            rows, x, loss, gradient, inverse, downhill, decrement, step = (part[~ended] for part in state)
    return ended_x, BatchReport(ended_loss, first_loss, n_iter, len(rows) == 0)


def _first_inverse(objective: ValueAndGradient, rows: Tensor, x: Tensor, gradient: Tensor) -> Tensor:
    """Inverse Hessians by differences, of positive eigenvalues; where there is none, of a step of one."""
    size = x.shape[-1]
    if len(x) == 0:
        return x.new_zeros(0, size, size)
    eye = torch.eye(size).to(x)
    _, shifted = objective((x + _DIFFERENCE * eye[:, None]).flatten(0, 1), rows.repeat(size))
    hessian = (shifted.reshape(size, *x.shape) - gradient).transpose(0, 1) / _DIFFERENCE
    sound = torch.isfinite(hessian).all(-1).all(-1)[:, None, None]
    hessian = torch.where(sound, 0.5 * (hessian + hessian.mT), gradient.norm(dim=-1)[:, None, None] * eye)
    curvature, axes = torch.linalg.eigh(hessian)
    curvature = curvature.abs()
    curvature = curvature.maximum(_LEAST_CURVATURE * curvature.amax(-1, keepdim=True)).clamp_min(1e-300)
    inverse = (axes / curvature.unsqueeze(-2)) @ axes.mT
    reach = (inverse @ gradient.unsqueeze(-1)).abs().amax((-2, -1))
    return inverse * (_FIRST_REACH / reach.clamp_min(_FIRST_REACH))[:, None, None]


def _updated(inverse: Tensor, step: Tensor, change: Tensor, convex: Tensor) -> Tensor:
    """Inverse Hessians after a step (b, p, 1) and the change of the gradient along it, where it was convex."""
    curvature = step.mT @ change
    applied = inverse @ change
    share = torch.where(convex[:, None, None], 1.0 / curvature, 0.0)
    cross = applied @ step.mT
    scale = 1.0 + share * (change.mT @ applied)
    update = share * (scale * (step @ step.mT) - cross - cross.mT)
    return inverse + update.where(convex[:, None, None], 0.0)


def _backtrack(
    objective: ValueAndGradient,
    rows: Tensor,
    x: Tensor,
    loss: Tensor,
    gradient: Tensor,
    downhill: Tensor,
    decrement: Tensor,
    step: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Shorten each problem's step until its loss falls enough; where none does it stays where it is."""
    trial = x - step[:, None] * downhill
    value, trial_gradient = objective(trial, rows)
    accepted = _accepted(value, trial_gradient, loss, step * decrement)
    if bool(accepted.all()):
        return trial, value, trial_gradient
    new_x, new_loss, new_gradient = x.clone(), loss.clone(), gradient.clone()
    left = torch.arange(len(rows), device=rows.device)
    for _ in range(25):
        done = left[accepted]
        new_x[done], new_loss[done], new_gradient[done] = trial[accepted], value[accepted], trial_gradient[accepted]
        # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
        parabola = 0.5 * step[left] * decrement[left] / ((value - loss[left]) / step[left] + decrement[left])
        shorter = torch.where(torch.isfinite(value + trial_gradient.sum(-1)), parabola, 0.1 * step[left])
        step = step.index_copy(0, left, shorter.clamp(0.1 * step[left], 0.5 * step[left]))
        left = left[~accepted]
        if len(left) == 0:
            break
        trial = x[left] - step[left, None] * downhill[left]
        value, trial_gradient = objective(trial, rows[left])
        accepted = _accepted(value, trial_gradient, loss[left], step[left] * decrement[left])
    return new_x, new_loss, new_gradient


def _accepted(value: Tensor, gradient: Tensor, loss: Tensor, promised: Tensor) -> Tensor:
    """Armijo's rule; a value that is not finite is not accepted."""
    return (value <= loss - 1e-4 * promised) & torch.isfinite(value + gradient.sum(-1))
