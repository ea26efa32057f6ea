"""Newton's method with a matrix that is never indefinite: Fisher scoring, Gauss-Newton."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_pbd.optim.report import FAILURES, BestSoFar, Callback, FitReport, Status

_ARMIJO = 1e-4  # least share of the fall that the slope promises, for a step to be taken
_LINEAR = 0.8  # with a larger share the loss is a line rather than a parabola, and a longer step is tried
_SHORTEST, _LONGEST = 1e-10, 1e3  # multiples of Newton's step
_SHORTFALL = 3e4  # of what is little, that a step may promise where its fall is little: it is never all of it

Newton = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Gradient and step at a point."""


class _Search(BestSoFar):
    """Point of an optimization, and the losses it has seen."""

    def __init__(self, loss: Callable[[Tensor], Tensor], start: Tensor, callback: Callback) -> None:
        super().__init__(callback)
        self._loss, self.x, self.n_iter = loss, start, 0
        self.value = self._evaluate(start)

    def _evaluate(self, x: Tensor) -> float:
        """Loss at x; NaN where it is not finite, or raises one of the exceptions of a bad point."""
        self.n_evaluations += 1
        try:
            value = float(self._loss(x))
        except FAILURES as error:
            if not self.curve:
                raise ValueError(f"The optimization cannot start: {error}.") from error
            return math.nan
        if self.is_lower(value):
            self.record(value)
        return value if math.isfinite(value) else math.nan

    def _line_search(self, step: Tensor, slope: float) -> tuple[Tensor, float]:
        """Point with a lower loss along a step, and that loss; the present point where there is none."""
        length, found, lowest = 1.0, self.x, self.value
        while _SHORTEST < length < _LONGEST:
            trial = self.x + length * step
            reached = self._evaluate(trial)
            share = (self.value - reached) / (-length * slope)  # NaN counts as too far
            if share >= _ARMIJO and reached < lowest:
                found, lowest = trial, reached
                if length < 1.0 or share <= _LINEAR:
                    break
                length *= 2.0
            elif found is not self.x:
                break
            else:
                # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
                parabola = 0.5 / (1.0 - share) if math.isfinite(share) else 0.1
                length *= min(0.5, max(0.1, parabola))
        return found, lowest

    def step(self, newton: Newton, enough: float, relative_tol: float) -> Status | None:
        """One iteration; how it ended the optimization, None if it did not."""
        self.n_iter += 1
        value, (gradient, step) = self.value, newton(self.x)
        slope = float((gradient * step).sum())
        if not math.isfinite(slope) or not bool(torch.isfinite(step).all()):
            raise ValueError(f"the gradient is not finite (loss {value}, slope {slope} along the step)")
        found, lowest = self._line_search(step, slope) if slope < 0 else (self.x, value)
        # A fall below the rounding of the loss cannot be seen.
        promise, rounding = -0.5 * slope, 1e-14 * max(1.0, abs(value))
        if found is self.x and promise > max(enough, rounding):
            return Status.LINE_SEARCH_FAILED
        self.x, self.value = found, lowest
        little = max(enough, relative_tol * abs(value), rounding)
        # A step that falls far short of its promise is short because of a bend, not because of an end.
        arrived = value - lowest <= 10.0 * enough and promise <= _SHORTFALL * little
        return Status.CONVERGED if promise <= little or arrived else None


@torch.no_grad()
def minimize_scoring(
    loss: Callable[[Tensor], Tensor],
    newton: Newton,
    start: Tensor,
    *,
    max_iter: int = 100,
    tol: float = 1e-8,
    relative_tol: float = 0.0,
    callback: Callback = None,
) -> tuple[Tensor, FitReport]:
    """Minimize a loss whose gradient and curvature are known in closed form; never ends above the start.

    Each iteration goes along the Newton step: all of it as a rule, less until the loss falls by a share of what
    the slope promises, more where it falls like a line.

    Parameters
    ----------
    loss : callable
        Maps a point to its loss, a scalar tensor; a value that is not finite counts as too far, and so does an
        ArithmeticError, ValueError, RuntimeError or IndexError that it raises.
    newton : callable
        Maps a point to gradient and step there, both shaped like it. The step is minus the gradient, multiplied
        by the inverse of a positive definite matrix.
    start : Tensor
    max_iter : int, default=100
        Largest number of steps.
    tol : float, default=1e-8
        Stop after a step that promises a fall below a hundredth of it, or brings one below a tenth, times the loss at
        the start where that is above one.
    relative_tol : float, default=0.0
        Or that promises one below this share of the loss. For sums of squares, whose smallest value is zero.
    callback : callable, optional
        Called with a :class:`~torch_pbd.optim.Progress` after each improvement.

    Returns
    -------
    point : Tensor
        The best seen.
    report : FitReport

    Raises
    ------
    ValueError
        If the loss, its gradient or the step is not finite at the start.
    """
    search = _Search(loss, start, callback)
    if not math.isfinite(search.value):
        raise ValueError(f"The optimization cannot start: the loss is not finite (loss {search.value}).")
    enough = 1e-2 * tol * max(1.0, abs(search.curve[0]))
    status, detail = None, ""
    while status is None and search.n_iter < max_iter:
        try:
            status = search.step(newton, enough, relative_tol)
        except FAILURES as error:
            if search.n_iter == 1:
                raise ValueError(f"The optimization cannot start: {error}.") from error
            status, detail = Status.NOT_FINITE, str(error)
    return search.x, FitReport(search.value, tuple(search.curve), search.n_iter, status or Status.MAX_ITER, detail)
