"""Many small independent optimizations in parallel, and reports of optimizations."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

FAILURES = (ArithmeticError, ValueError, RuntimeError, IndexError)
"""Exceptions of an evaluation at a bad point: Cholesky and eigenvalues, overflow. Others are mistakes, passed on."""

_LONGEST_STEP = 1e3  # in steps of BFGS
_DIFFERENCE = 1e-4  # step of the first Hessian in parameters of order one: relative error 1e-4, or 1e-12 by rounding
_LEAST_CURVATURE = 1e-3  # share of a Hessian's largest curvature at which the curvature of flat directions is clamped
_FIRST_REACH = 1.0  # largest change of any parameter in the first step
_ARMIJO = 1e-4  # least share of the fall that the slope promises (Nocedal and Wright, section 3.1)
_HALVINGS = 25  # down to 3e-8 of a step at most

ValueAndGradient = Callable[
    [Float[Tensor, "a p"], Int64[Tensor, " a"]], tuple[Float[Tensor, " a"], Float[Tensor, "a p"]]
]


class Status(Enum):
    """Status of a finished optimization; the value is its description."""

    CONVERGED = "converged"
    MAX_ITER = "stopped at max_iter iterations"  # or at the most evaluations for these
    LINE_SEARCH_FAILED = "no step lowers the loss, though its slope says so"
    NOT_FINITE = "the loss or its gradient is not finite"


def first_failure(statuses: Iterable[Status]) -> Status:
    """Status of the first of several optimizations that did not converge; CONVERGED if all did."""
    return next((status for status in statuses if status is not Status.CONVERGED), Status.CONVERGED)


@dataclass(frozen=True)
class Progress:
    """Argument of a progress callback, after each evaluation that improved the loss."""

    n_evaluations: int
    loss: float
    elapsed: float
    """Seconds since the start."""


Callback = Callable[[Progress], None] | None


@dataclass(frozen=True)
class FitReport:
    """Result of an optimization: loss, iterations and status."""

    loss: float
    loss_curve: tuple[float, ...]
    """Best loss so far, at each evaluation that improved it; the first is the loss at the start."""
    n_iter: int
    status: Status
    detail: str = ""
    """Message of an exception, or name of a search, where the status alone does not tell."""

    @property
    def converged(self) -> bool:
        """Whether the optimization converged."""
        return self.status is Status.CONVERGED

    @property
    def message(self) -> str:
        """Description of the status in words."""
        return self.detail or self.status.value

    def after(self, other: "FitReport", name: str) -> "FitReport":
        """Report with the status of a previous optimization, called ``name``, where that has not converged."""
        if other.converged or not self.converged:
            return self
        return replace(self, status=other.status, detail=f"{name}: {other.message}")


@dataclass(frozen=True)
class BatchReport:
    """Result of each optimization in a batch."""

    loss: Float[Tensor, " b"]
    start_loss: Float[Tensor, " b"]
    n_iter: int
    status: Status
    """CONVERGED if all did, from starts whose loss is finite; else how one ended that did not."""
    inverse_hessian: Float[Tensor, "b p p"]
    """BFGS's estimate at the ends."""


def minimize_batch(
    objective: ValueAndGradient,
    start: Float[Tensor, "b p"],
    *,
    max_iter: int = 100,
    tol: float = 1e-6,
    inverse_hessian: Float[Tensor, "b p p"] | None = None,
) -> tuple[Float[Tensor, "b p"], BatchReport]:
    """Minimize b unrelated objectives of few parameters (b, p), of order one, by BFGS, their evaluations in one batch.

    Each problem has its own inverse Hessian, its own step and its own end: a joint L-BFGS over all of them would share
    one line search and one memory between problems that have nothing to do with each other, and with a handful of
    parameters the whole matrix costs less than a limited memory of it. Steps are accepted by the Armijo rule, so the
    loss never rises. Where the slope along a step has not fallen, which tells no Hessian, the next step starts four
    times as long.

    ``objective`` is asked for the losses and gradients of some of the problems, by their indices. A value that is not
    finite counts as too far, and so do problems at whose points it raises one of ``FAILURES``, which it is then asked
    for one by one; a problem that starts there stays. A problem ends when its gradient, summed over its absolute
    entries, is below ``tol``, when its next step promises less than a hundredth of it, or when no step gained anything.
    Inverse Hessians that are not given are estimated by differences of the gradient.
    """
    objective = guarded(objective)
    rows = torch.arange(len(start), device=start.device)
    every = _start(objective, rows, start.detach().clone(), inverse_hessian)
    first = every.loss
    size = every.gradient.abs().sum(-1)  # zero without parameters, where there is nothing to do
    finite = torch.isfinite(first + size)
    active = every.restrict(finite & (size > tol) & (every.promise > _negligible(first, tol)))
    n_iter, status = 0, Status.CONVERGED if bool(finite.all()) else Status.NOT_FINITE
    while n_iter < max_iter and len(active.rows):
        n_iter += 1
        active, settled, blocked = _advance(objective, active, tol, first=n_iter == 1)
        if bool(blocked.any()):
            status = Status.NOT_FINITE
        if bool(settled.any()) or n_iter == max_iter:  # problems that have ended are not carried along
            every.put(active)
            active = active.restrict(~settled)
    if status is Status.CONVERGED and len(active.rows):
        status = Status.MAX_ITER
    return every.x, BatchReport(every.loss, first, n_iter, status, every.inverse)


def guarded(objective: ValueAndGradient) -> ValueAndGradient:
    """The objective, with NaN for problems at whose points it raises; they are found one by one."""

    def one_by_one(x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        try:
            return objective(x, rows)
        except FAILURES:
            if len(rows) < 2:
                return x.new_full((len(x),), math.nan), torch.full_like(x, math.nan)
            losses, gradients = zip(*(one_by_one(x[i : i + 1], rows[i : i + 1]) for i in range(len(rows))), strict=True)
            return torch.cat(losses), torch.cat(gradients)

    return one_by_one


@dataclass
class _Problems:
    """Present points of optimizations, and Newton's step from there."""

    rows: Int64[Tensor, " a"]
    x: Float[Tensor, "a p"]
    loss: Float[Tensor, " a"]
    gradient: Float[Tensor, "a p"]
    inverse: Float[Tensor, "a p p"]
    step: Float[Tensor, " a"]
    """Multiple of Newton's step that is tried next."""

    @cached_property
    def downhill(self) -> Float[Tensor, "a p 1"]:
        """Newton's step, but for its sign."""
        return self.inverse @ self.gradient.unsqueeze(-1)

    @cached_property
    def promise(self) -> Float[Tensor, " a"]:
        """Fall of the loss by Newton's step, were the loss the parabola that it is taken for."""
        return 0.5 * (self.gradient * self.downhill.squeeze(-1)).sum(-1)

    def restrict(self, chosen: Bool[Tensor, " a"]) -> "_Problems":
        """Problems that are chosen."""
        if bool(chosen.all()):
            return self
        return _Problems(*(getattr(self, part.name)[chosen] for part in fields(self)))

    def put(self, others: "_Problems") -> None:
        """Take the present points of some of the problems."""
        for name in ("x", "loss", "inverse"):
            setattr(self, name, getattr(self, name).index_copy(0, others.rows, getattr(others, name)))


def _advance(
    objective: ValueAndGradient, at: _Problems, tol: float, *, first: bool
) -> tuple[_Problems, Bool[Tensor, " a"], Bool[Tensor, " a"]]:
    """Problems after a step each, which of them have ended, and which for want of finite numbers."""
    x, loss, gradient, blocked = _backtrack(objective, at)
    change = (gradient - at.gradient).unsqueeze(-1)
    # Where the slope along a step has not fallen the curvature is not that of a minimum.
    convex = (change * at.downhill).sum((-2, -1)) < -2e-3 * at.promise
    inverse = _bfgs_update(at.inverse, (x - at.x).unsqueeze(-1), change, convex)
    gain = at.loss - loss
    short = ~convex & (gain > 0) & (at.step < _LONGEST_STEP) & (not first)
    new = _Problems(at.rows, x, loss, gradient, inverse, torch.where(short, 4.0 * at.step, 1.0))
    settled = ((new.promise <= _negligible(loss, tol)) | (gain <= 0.0)) & ~short
    return new, settled | (gradient.abs().sum(-1) <= tol), blocked


def _negligible(loss: Tensor, tol: float) -> Tensor:
    """Gain that is none."""
    return 1e-2 * tol + torch.finfo(loss.dtype).eps * loss.abs()


def _start(objective: ValueAndGradient, rows: Tensor, x: Tensor, inverse_hessian: Tensor | None) -> _Problems:
    """Problems at the start; inverse Hessians that are not given are by differences of the gradient.

    These get the absolute values of their eigenvalues; where they are not finite they are of a step of length one.
    """
    one = x.new_ones(len(x))
    if inverse_hessian is not None:
        return _Problems(rows, x, *objective(x, rows), inverse_hessian.clone(), one)
    size = x.shape[-1]
    eye = torch.eye(size).to(x)
    shifts = torch.cat([eye.new_zeros(1, size), _DIFFERENCE * eye])
    losses, gradients = objective((x + shifts[:, None]).flatten(0, 1), rows.repeat(len(shifts)))
    loss, (gradient, *shifted) = losses[: len(x)], gradients.reshape(len(shifts), *x.shape)
    if not size:
        return _Problems(rows, x, loss, gradient, x.new_zeros(len(x), 0, 0), one)
    hessian = (torch.stack(shifted, dim=1) - gradient[:, None]) / _DIFFERENCE
    sound = torch.isfinite(hessian).all(-1).all(-1)[:, None, None]
    length = gradient.norm(dim=-1).nan_to_num(nan=1.0).clamp_min(1e-300)[:, None, None]
    curvature, axes = torch.linalg.eigh(torch.where(sound, 0.5 * (hessian + hessian.mT), length * eye))
    curvature = curvature.abs()
    curvature = curvature.maximum(_LEAST_CURVATURE * curvature.amax(-1, keepdim=True)).clamp_min(1e-300)
    inverse = (axes / curvature.unsqueeze(-2)) @ axes.mT
    reach = (inverse @ gradient.unsqueeze(-1)).abs().amax((-2, -1))
    inverse = inverse * (_FIRST_REACH / reach.clamp_min(_FIRST_REACH))[:, None, None]
    return _Problems(rows, x, loss, gradient, inverse, one)


def _bfgs_update(inverse: Tensor, step: Tensor, change: Tensor, convex: Tensor) -> Tensor:
    """Inverse Hessians after a step s (b, p, 1) and the change y of the gradient along it, where it was convex.

    With r = 1 / (y's) it is ``(I - r s y') H (I - r y s') + r s s'`` (Nocedal and Wright, eq. (6.17)), multiplied out.
    """
    applied = inverse @ change
    share = torch.where(convex[:, None, None], 1.0 / (step.mT @ change), 0.0)  # the update is zero where it is
    cross = applied @ (share * step.mT)
    scale = share + share.square() * (change.mT @ applied)
    return inverse + scale * step @ step.mT - cross - cross.mT


def _backtrack(objective: ValueAndGradient, at: _Problems) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points, losses and gradients of each problem after a step, shortened until the loss falls enough.

    Where no step does a problem stays where it is; the last of the results are those that stay because nothing is
    finite any more, even there.
    """
    x, loss, gradient, step = at.x, at.loss, at.gradient, at.step
    left = torch.arange(len(step), device=step.device)
    blocked = torch.zeros_like(left, dtype=torch.bool)
    for _ in range(_HALVINGS):
        before, slope, share = at.loss[left], 2.0 * at.promise[left], step[left]
        trial = at.x[left] - share[:, None] * at.downhill[left].squeeze(-1)
        value, its_gradient = objective(trial, at.rows[left])
        finite = torch.isfinite(value + its_gradient.sum(-1))
        accepted = finite & (value <= before - _ARMIJO * (share * slope))
        x = x.index_copy(0, left[accepted], trial[accepted])
        loss = loss.index_copy(0, left[accepted], value[accepted])
        gradient = gradient.index_copy(0, left[accepted], its_gradient[accepted])
        if bool(accepted.all()):
            return x, loss, gradient, blocked
        # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
        parabola = 0.5 * share * slope / ((value - before) / share + slope)
        shorter = torch.where(finite, parabola, 0.1 * share).clamp(0.1 * share, 0.5 * share)
        step, left = step.index_copy(0, left, shorter), left[~accepted]
    value, its_gradient = objective(at.x[left], at.rows[left])
    blocked[left] = ~torch.isfinite(value + its_gradient.sum(-1))
    return x, loss, gradient, blocked
