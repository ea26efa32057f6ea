"""L-BFGS and Fisher scoring on one objective; neither loses its best point."""

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_pbd.optim.batch import FAILURES, Callback, FitReport, Progress, Status

_ATTEMPTS = 4  # with first steps of 1, 1/2, 1/4 and 1/8 of what torch takes

_ARMIJO = 1e-4  # least share of the fall that the slope promises, for a step to be taken
_LINEAR = 0.8  # with a larger share the loss is a line rather than a parabola, and a longer step is tried
_SHORTEST, _LONGEST = 1e-10, 1e3  # multiples of Newton's step
_SHORTFALL = 3e4  # of what is little, that a step may promise where its fall is little: it is never all of it

Newton = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Gradient and step at a point."""


class _BestSoFar:
    """Base of searches: the falling curve of their best losses, of which a callback hears."""

    def __init__(self, callback: Callback) -> None:
        self.curve: list[float] = []
        self.n_evaluations = 0
        self._callback, self._started = callback, time.perf_counter()

    def is_lower(self, loss: float) -> bool:
        """Whether a loss is finite and below all before it."""
        return math.isfinite(loss) and (not self.curve or loss < self.curve[-1])

    def record(self, loss: float) -> None:
        """Take a lower loss for the best so far."""
        self.curve.append(loss)
        if self._callback is not None:
            self._callback(Progress(self.n_evaluations, loss, time.perf_counter() - self._started))


class _NotFiniteError(ArithmeticError):
    """The loss or its gradient is not a finite number, or could not be computed."""


class _Closure(_BestSoFar):
    """Closure for ``torch.optim``: loss and gradients at the parameters, and memory of the best of them."""

    def __init__(self, objective: Callable[[], Tensor], parameters: Sequence[Tensor], callback: Callback) -> None:
        super().__init__(callback)
        self._objective, self._parameters = objective, parameters
        self._best: list[Tensor] = []
        self._gradients: Sequence[Tensor] = []

    def __call__(self) -> float:
        # Each attempt begins with the loss at the best point, which is known.
        known = bool(self._best) and all(map(torch.equal, self._parameters, self._best))
        value, gradients = (self.curve[-1], self._gradients) if known else self._evaluate()
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient.clone()
        if self.is_lower(value):
            self._best = [parameter.detach().clone() for parameter in self._parameters]
            self._gradients = gradients
            self.record(value)
        return value

    def _evaluate(self) -> tuple[float, Sequence[Tensor]]:
        self.n_evaluations += 1
        try:
            with torch.enable_grad():
                loss = self._objective()
                gradients = torch.autograd.grad(loss, self._parameters, materialize_grads=True)
        except FAILURES as error:
            raise _NotFiniteError(str(error) or type(error).__name__) from error
        value = float(loss.detach())
        if not math.isfinite(value) or not all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            raise _NotFiniteError(f"{Status.NOT_FINITE.value} (loss {value})")
        return value, [gradient.contiguous() for gradient in gradients]

    @torch.no_grad()
    def restore(self) -> None:
        """Put the best parameters back, without gradients."""
        for parameter, value in zip(self._parameters, self._best, strict=False):  # none where the start is not finite
            parameter.copy_(value)
            parameter.grad = None


def minimize(
    objective: Callable[[], Tensor],
    parameters: Sequence[Tensor],
    *,
    max_iter: int = 200,
    tol: float = 1e-8,
    callback: Callback = None,
) -> FitReport:
    """Minimize a scalar objective by L-BFGS with a strong Wolfe line search; leaves the best point seen.

    ``torch.optim.LBFGS`` can raise from its line search, and can return from a failed one at a worse point.
    Here a failed run is restarted from the best point with a halved first step, at most three times. Whatever ends it,
    be it a mistake in the objective or an interrupt, the parameters are left at the best point.

    Parameters
    ----------
    objective : callable
        Returns the loss, a scalar tensor, at the present values of ``parameters``. An ArithmeticError, ValueError,
        RuntimeError or IndexError that it raises counts as a loss that is not finite.
    parameters : sequence of Tensor
        Leaf tensors, changed in place.
    max_iter : int, default=200
        Largest number of L-BFGS iterations, over all restarts.
    tol : float, default=1e-8
        Stop when the largest gradient entry, or the change of the loss, is below it: scale the objective
        so that one unit matters.
    callback : callable, optional
        Called with a :class:`~torch_pbd.optim.Progress` after each improvement.

    Returns
    -------
    FitReport
        Its loss is never above that of the start.

    Raises
    ------
    ValueError
        If the loss or its gradient is not finite at the start.
    """
    closure, n_iter = _Closure(objective, parameters, callback), 0
    try:
        closure()
        for number in range(_ATTEMPTS):
            max_eval = 2 * (max_iter - n_iter) + 21  # a search takes one or two; the first is known
            optimizer = torch.optim.LBFGS(
                list(parameters),
                lr=0.5**number,
                max_iter=max_iter - n_iter,
                max_eval=max_eval,
                tolerance_grad=tol,
                tolerance_change=tol * max(1.0, abs(closure.curve[0])) * 1e-2,
                history_size=20,  # pairs of steps and changes of the gradient
                line_search_fn="strong_wolfe",
            )
            memory, detail = optimizer.state[parameters[0]], ""
            try:
                optimizer.step(closure)
                status = Status.CONVERGED if memory["func_evals"] < max_eval else Status.MAX_EVALUATIONS
            except _NotFiniteError as error:
                status, detail = Status.NOT_FINITE, str(error)
            except FAILURES as error:  # an IndexError where torch's strong Wolfe search brackets no minimum
                status = Status.LINE_SEARCH_FAILED
                detail = f"the line search failed ({type(error).__name__}: {error})"
            n_iter += memory["n_iter"]
            closure.restore()
            if status is Status.CONVERGED or n_iter >= max_iter:
                break
    except _NotFiniteError as error:  # at the start: an attempt ends with its own
        raise ValueError(f"The optimization cannot start: {error}.") from error
    finally:
        closure.restore()
    if status is Status.CONVERGED and n_iter >= max_iter:
        status = Status.MAX_ITER
    return FitReport(closure.curve[-1], tuple(closure.curve), n_iter, status, detail)


class _Search(_BestSoFar):
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
