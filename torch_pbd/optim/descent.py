"""L-BFGS and Fisher scoring on one objective; both keep their best point."""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from torch_pbd.optim.batch import FAILURES, Callback, FitReport, Progress, Status

_ATTEMPTS = 4  # with first steps of 1, 1/2, 1/4 and 1/8 of what torch takes

_ARMIJO = 1e-4  # least share of the fall that the slope promises, for a step to be taken
_LINEAR = 0.8  # with a larger share the loss is a line rather than a parabola, and a longer step is tried
_SHORTEST, _LONGEST = 1e-10, 1e3  # multiples of Newton's step
_SHORTFALL = 3e4  # of what is little, that a step may promise where its fall is little: it is never all of it


class _Curve:
    """Falling curve of the best losses, of which a callback hears."""

    def __init__(self, callback: Callback) -> None:
        self.losses: list[float] = []
        self._n_evaluations, self._callback, self._started = 0, callback, time.perf_counter()

    def add(self, loss: float) -> bool:
        """Count an evaluation; whether its loss is finite and the lowest so far."""
        self._n_evaluations += 1
        if not math.isfinite(loss) or (self.losses and loss >= self.losses[-1]):
            return False
        self.losses.append(loss)
        if self._callback is not None:
            self._callback(Progress(self._n_evaluations, loss, time.perf_counter() - self._started))
        return True


class _NotFiniteError(ArithmeticError):
    """The loss or its gradient is not a finite number, or could not be computed."""


class _Closure:
    """Closure for ``torch.optim``: loss and gradients at the parameters, and memory of the best of them."""

    def __init__(self, objective: Callable[[], Tensor], parameters: Sequence[Tensor], callback: Callback) -> None:
        self.curve = _Curve(callback)
        self._objective, self._parameters = objective, parameters
        self._best: list[Tensor] = []

    def __call__(self) -> float:
        try:
            with torch.enable_grad():
                loss = self._objective()
                gradients = torch.autograd.grad(loss, self._parameters, materialize_grads=True)
        except FAILURES as error:
            raise _NotFiniteError(str(error) or type(error).__name__) from error
        value = float(loss.detach())
        if not math.isfinite(value) or not all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            raise _NotFiniteError(f"{Status.NOT_FINITE.value} (loss {value})")
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient.contiguous()
        if self.curve.add(value):
            self._best = [parameter.detach().clone() for parameter in self._parameters]
        return value

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
    """Minimize a scalar objective by L-BFGS with a strong Wolfe line search, in place; leaves the best point seen.

    ``torch.optim.LBFGS`` can raise from its line search, and can return from a failed one at a worse point. Here a
    failed run is restarted from the best point with a halved first step, at most three times. Whatever ends it, be it a
    mistake in the objective or an interrupt, the parameters are left at the best point.

    It stops when the largest gradient entry, or the change of the loss, is below ``tol``: scale the objective so that
    one unit matters. One of ``FAILURES`` that the objective raises counts as a loss that is not finite; at the start
    that is a ValueError. ``callback`` hears of each improvement.
    """
    closure, n_iter = _Closure(objective, parameters, callback), 0
    losses = closure.curve.losses
    try:
        closure()
        for number in range(_ATTEMPTS):
            max_eval = 2 * (max_iter - n_iter) + 21  # a line search takes one or two
            optimizer = torch.optim.LBFGS(
                list(parameters),
                lr=0.5**number,
                max_iter=max_iter - n_iter,
                max_eval=max_eval,
                tolerance_grad=tol,
                tolerance_change=tol * max(1.0, abs(losses[0])) * 1e-2,
                history_size=20,  # pairs of steps and changes of the gradient
                line_search_fn="strong_wolfe",
            )
            memory, detail = optimizer.state[parameters[0]], ""
            try:
                optimizer.step(closure)
                status = Status.CONVERGED if memory["func_evals"] < max_eval else Status.MAX_ITER
            except _NotFiniteError as error:
                status, detail = Status.NOT_FINITE, str(error)
            except FAILURES as error:  # an IndexError where torch's strong Wolfe search brackets no minimum
                status = Status.LINE_SEARCH_FAILED
                detail = f"the line search failed ({type(error).__name__}: {error})"
            n_iter += memory.get("n_iter", 0)
            closure.restore()
            if status is Status.CONVERGED or n_iter >= max_iter:
                break
    except _NotFiniteError as error:  # at the start: an attempt ends with its own
        raise ValueError(f"The optimization cannot start: {error}.") from error
    finally:
        closure.restore()
    if status is Status.CONVERGED and n_iter >= max_iter:
        status = Status.MAX_ITER
    return FitReport(losses[-1], tuple(losses), n_iter, status, detail)


@torch.no_grad()
def minimize_scoring(
    loss: Callable[[Tensor], Tensor],
    newton: Callable[[Tensor], tuple[Tensor, Tensor]],
    start: Tensor,
    *,
    max_iter: int = 100,
    tol: float = 1e-8,
    callback: Callback = None,
) -> tuple[Tensor, FitReport]:
    """Minimize a loss by steps of Newton's kind, known in closed form: the best point seen, never above the start.

    ``newton`` gives the gradient at a point, and the step: minus the gradient, times the inverse of a positive definite
    matrix. Each iteration goes along it: all of it as a rule, less until the loss falls by a share of what the slope
    promises, more where it falls like a line. A loss that is not finite counts as too far, and so does one of
    ``FAILURES``; at the start it is a ValueError.

    It stops after a step that promises a fall below a hundredth of ``tol``, or brings one below a tenth, times the loss
    at the start where that is above one.
    """
    curve = _Curve(callback)
    evaluate = partial(_evaluate, loss, curve)
    x, value = start, evaluate(start)
    if not math.isfinite(value):
        raise ValueError(f"The optimization cannot start: the loss is not finite (loss {value}).")
    enough = 1e-2 * tol * max(1.0, abs(value))
    n_iter, status, detail = 0, Status.MAX_ITER, ""
    while n_iter < max_iter and status is Status.MAX_ITER:
        n_iter += 1
        try:
            gradient, step = newton(x)
            slope = float((gradient * step).sum())
            if not math.isfinite(slope) or not bool(torch.isfinite(step).all()):
                raise ValueError(f"the gradient is not finite (loss {value}, slope {slope} along the step)")
        except FAILURES as error:
            if n_iter == 1:
                raise ValueError(f"The optimization cannot start: {error}.") from error
            status, detail = Status.NOT_FINITE, str(error)
            break
        found, lowest = _line_search(evaluate, x, value, step, slope) if slope < 0 else (x, value)
        # A fall below the rounding of the loss cannot be seen.
        promise, little = -0.5 * slope, max(enough, 1e-14 * max(1.0, abs(value)))
        # A step that falls far short of its promise is short because of a bend, not because of an end.
        arrived = value - lowest <= 10.0 * enough and promise <= _SHORTFALL * little
        if found is x and promise > little:
            status = Status.LINE_SEARCH_FAILED
        elif promise <= little or arrived:
            status = Status.CONVERGED
        x, value = found, lowest
    return x, FitReport(value, tuple(curve.losses), n_iter, status, detail)


def _evaluate(loss: Callable[[Tensor], Tensor], curve: _Curve, x: Tensor) -> float:
    """Loss at x; NaN where it is not finite, or raises one of the exceptions of a bad point."""
    try:
        value = float(loss(x))
    except FAILURES as error:
        if not curve.losses:
            raise ValueError(f"The optimization cannot start: {error}.") from error
        value = math.nan
    curve.add(value)
    return value if math.isfinite(value) else math.nan


def _line_search(
    evaluate: Callable[[Tensor], float], x: Tensor, value: float, step: Tensor, slope: float
) -> tuple[Tensor, float]:
    """Point with a lower loss along a step, and that loss; the present point where there is none."""
    length, found, lowest = 1.0, x, value
    while _SHORTEST < length < _LONGEST:
        trial = x + length * step
        reached = evaluate(trial)
        share = (value - reached) / (-length * slope)  # NaN counts as too far
        if share >= _ARMIJO and reached < lowest:
            found, lowest = trial, reached
            if length < 1.0 or share <= _LINEAR:
                break
            length *= 2.0
        elif found is not x:
            break
        else:
            # The minimum of the parabola through both values and the slope, kept within a tenth and a half.
            parabola = 0.5 / (1.0 - share) if math.isfinite(share) else 0.1
            length *= min(0.5, max(0.1, parabola))
    return found, lowest
