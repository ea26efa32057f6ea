"""Newton's method with a matrix that is never indefinite: Fisher scoring, Gauss-Newton."""

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_pbd.optim.journal import Record, State
from torch_pbd.optim.lbfgs import FAILURES, FitReport, Progress

_LEAST_SHARE = 1e-4  # of the fall that the slope promises, for a step to be taken
_LINEAR_SHARE = 0.8  # with more of it the loss is a line rather than a parabola, and a longer step is tried
_SHORTEST, _LONGEST = 1e-10, 1e3
_SHORTFALL = 3e4  # of what is little, that a step may promise where its fall is little: it is never all of it

Newton = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Gradient and step at a point."""


class _Search:
    """Where the optimization is; evaluates losses, counts, and tells the callback of each improvement."""

    def __init__(
        self,
        loss: Callable[[Tensor], Tensor],
        callback: Callable[[Progress], None] | None,
        start: Tensor,
        carried: Sequence[Tensor],
    ) -> None:
        self.loss, self.callback, self.carried = loss, callback, carried
        self.x, self.value = start, math.nan
        self.curve: list[float] = []
        self.n_iter = self.n_evaluations = 0
        self.started = time.perf_counter()

    def evaluate(self, x: Tensor) -> float:
        """Loss at x; NaN where it is not finite, or raises what an evaluation at a bad point raises."""
        self.n_evaluations += 1
        try:
            value = float(self.loss(x))
        except FAILURES as error:
            if not self.curve:
                raise ValueError(f"The optimization cannot start: {error}.") from error
            return math.nan
        if not self.curve or value < self.curve[-1]:
            if not math.isfinite(value):
                return math.nan
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

    def step(self, newton: Newton, enough: float, relative_tol: float) -> str:
        """One iteration; why it was the last, "" if it was not."""
        self.n_iter += 1
        value, (gradient, step) = self.value, newton(self.x)
        slope = float((gradient * step).sum())
        if not math.isfinite(slope) or not bool(torch.isfinite(step).all()):
            raise ValueError(f"the gradient is not finite (loss {value}, slope {slope} along the step)")
        found, lowest = self.along(self.x, value, step, slope) if slope < 0 else (self.x, value)
        # Of a fall below the rounding of the loss nothing can be seen.
        rounding = 1e-14 * max(1.0, abs(value))
        if found is self.x and -0.5 * slope > max(enough, rounding):
            return "no step lowers the loss, though its slope says so"
        self.x, self.value = found, lowest
        little, promise = max(enough, relative_tol * abs(value), rounding), -0.5 * slope
        # A step that falls far short of its promise is short because of a bend, not because of an end.
        arrived = value - lowest <= 10.0 * enough and promise <= _SHORTFALL * little
        return "converged" if promise <= little or arrived else ""

    def report(self, message: str) -> FitReport:
        """How it ended, or where it is."""
        return FitReport(self.value, tuple(self.curve), self.n_iter, message == "converged", message)

    def state(self, message: str) -> State:
        """As a journal keeps it."""
        kept = {f"carried.{i}": tensor.clone() for i, tensor in enumerate(self.carried)}
        return self.report(message).state() | {"x": self.x.clone(), "n_evaluations": self.n_evaluations} | kept

    def resume(self, state: State) -> FitReport:
        """Go on from :meth:`state`; the report it was at."""
        report = FitReport.of(state)
        self.x, self.value, self.curve = state["x"].to(self.x), report.loss, list(report.loss_curve)
        self.n_iter, self.n_evaluations = report.n_iter, state["n_evaluations"]
        for i, tensor in enumerate(self.carried):
            tensor.copy_(state[f"carried.{i}"])
        return report


@torch.no_grad()
def minimize_scoring(
    loss: Callable[[Tensor], Tensor],
    newton: Newton,
    start: Tensor,
    *,
    max_iter: int = 100,
    tol: float = 1e-8,
    relative_tol: float = 0.0,
    carried: Sequence[Tensor] = (),
    callback: Callable[[Progress], None] | None = None,
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
    carried : sequence of Tensor, default=()
        What ``newton`` changes and its next call starts from: kept with the point in a journal.
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
    record = Record("scoring", start)
    search = _Search(loss, callback, start, carried)
    if record.state:
        report = search.resume(record.state)
        if record.ended:
            return search.x, report
    else:
        search.value = search.evaluate(start)
        if not math.isfinite(search.value):
            raise ValueError(f"The optimization cannot start: the loss is not finite (loss {search.value}).")
    enough = 1e-2 * tol * max(1.0, abs(search.curve[0]))
    message = ""
    while not message and search.n_iter < max_iter:
        try:
            message = search.step(newton, enough, relative_tol)
        except FAILURES as error:
            if search.n_iter == 1:
                raise ValueError(f"The optimization cannot start: {error}.") from error
            message = str(error)
        if not message:
            record.keep(lambda: search.state(""))
    message = message or f"stopped at max_iter={max_iter} iterations"
    record.keep(lambda: search.state(message), ended=True)
    return search.x, search.report(message)
