"""Newton's method with a matrix that is never indefinite: Fisher scoring, Gauss-Newton."""

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from torch_pbd.optim.lbfgs import FitReport, Progress

_LEAST_SHARE = 1e-4  # of the fall that the slope promises, for a step to be taken
_LINEAR_SHARE = 0.8  # with more of it the loss is a line rather than a parabola, and a longer step is tried
_SHORTEST, _LONGEST = 1e-10, 1e3


class _Search:
    """Loss along a step: evaluates, counts, and tells the callback of each improvement."""

    def __init__(self, loss: Callable[[Tensor], Tensor], callback: Callable[[Progress], None] | None) -> None:
        self.loss, self.callback = loss, callback
        self.curve: list[float] = []
        self.n_evaluations = 0
        self.started = time.perf_counter()

    def evaluate(self, x: Tensor) -> float:
        self.n_evaluations += 1
        value = float(self.loss(x))
        if not self.curve or value < self.curve[-1]:
            self.curve.append(value)
            if self.callback is not None:
                self.callback(Progress(self.n_evaluations, value, time.perf_counter() - self.started))
        return value

    def along(self, x: Tensor, value: float, step: Tensor, slope: float) -> tuple[Tensor, float]:
        """Point with a lower loss on the way from ``x``, and that loss; ``x`` itself where there is none."""
        length, found, lowest = 1.0, x, value
        while _SHORTEST < length < _LONGEST:
            trial = x + length * step
            reached = self.evaluate(trial)
            share = (value - reached) / (-length * slope)  # NaN counts as too far
            if not share >= _LEAST_SHARE or reached >= lowest:
                if found is not x:
                    break
                # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
                parabola = 0.5 / (1.0 - share) if math.isfinite(share) else 0.1
                length *= min(0.5, max(0.1, parabola))
                continue
            longer = length >= 1.0 and share > _LINEAR_SHARE
            found, lowest = trial, reached
            if not longer:
                break
            length *= 2.0
        return found, lowest


@torch.no_grad()
def minimize_scoring(
    loss: Callable[[Tensor], Tensor],
    newton: Callable[[Tensor], tuple[Tensor, Tensor]],
    start: Tensor,
    *,
    max_iter: int = 100,
    tol: float = 1e-8,
    relative_tol: float = 0.0,
    callback: Callable[[Progress], None] | None = None,
) -> tuple[Tensor, FitReport]:
    """Minimize a loss whose gradient and curvature are known in closed form; never ends above the start.

    Each iteration goes along the Newton step: all of it as a rule, less until the loss falls by a share of what
    the slope promises, more where it falls like a line.

    Parameters
    ----------
    loss : callable
        Maps a point to its loss, a scalar tensor; a value that is not finite counts as too far.
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
        Called with a :class:`Progress` after each improvement.

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
    search = _Search(loss, callback)
    x, value, message = start, search.evaluate(start), ""
    enough = 1e-2 * tol * max(1.0, abs(value))
    for n_iter in range(1, max_iter + 1):
        gradient, step = newton(x)
        slope = float((gradient * step).sum())
        if not math.isfinite(slope + value) or not bool(torch.isfinite(step).all()):
            if n_iter == 1:
                raise ValueError(f"The optimization cannot start: loss {value}, slope {slope} along the first step.")
            message = "the gradient is not finite"
            break
        found, lowest = search.along(x, value, step, slope) if slope < 0 else (x, value)
        if found is x and -0.5 * slope > max(enough, 1e-14 * max(1.0, abs(value))):
            message = "no step lowers the loss, though its slope says so"
            break
        # Of a fall below the rounding of the loss nothing can be seen.
        little = max(enough, relative_tol * abs(value), 1e-14 * max(1.0, abs(value)))
        ended = -0.5 * slope <= little or value - lowest <= 10.0 * enough
        x, value = found, lowest
        if ended:
            return x, FitReport(value, tuple(search.curve), n_iter, True, "converged")
    message = message or f"stopped at max_iter={max_iter} iterations"
    return x, FitReport(value, tuple(search.curve), n_iter, False, message)
