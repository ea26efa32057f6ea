"""L-BFGS on one objective, which never loses its best point."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_pbd.optim.report import FAILURES, BestSoFar, Callback, FitReport, Status

_ATTEMPTS = 4  # with first steps of 1, 1/2, 1/4 and 1/8 of what torch takes


class _NotFiniteError(ArithmeticError):
    """The loss or its gradient is not a finite number, or could not be computed."""


class _Closure(BestSoFar):
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
