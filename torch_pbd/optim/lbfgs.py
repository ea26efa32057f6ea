"""L-BFGS on one objective, which never loses its best point."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_pbd.exceptions import NotPositiveDefiniteError


@dataclass(frozen=True)
class Progress:
    """What a progress callback is told after each evaluation that improved the loss."""

    n_evaluations: int
    loss: float
    elapsed: float
    """Seconds since the start."""


@dataclass(frozen=True)
class FitReport:
    """How an optimization ended."""

    loss: float
    loss_curve: tuple[float, ...]
    """Best loss so far, at each evaluation that improved it; the first is the loss at the start."""
    n_iter: int
    converged: bool
    message: str


class _NotFiniteError(ArithmeticError):
    """The loss or its gradient is not a finite number."""


_FAILURES = (
    _NotFiniteError,
    NotPositiveDefiniteError,
    torch.linalg.LinAlgError,  # type: ignore[attr-defined]
    IndexError,  # torch's strong Wolfe search, when it brackets no minimum
)


@dataclass
class _BestPoint:
    """The closure L-BFGS calls: evaluates, and remembers the best parameters it has seen."""

    objective: Callable[[], Tensor]
    parameters: Sequence[Tensor]
    callback: Callable[[Progress], None] | None
    n_evaluations: int = 0
    curve: list[float] = field(default_factory=list)
    best: list[Tensor] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    def __call__(self) -> float:
        self.n_evaluations += 1
        with torch.enable_grad():
            loss = self.objective()
            gradients = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        value = float(loss.detach())
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = torch.zeros_like(parameter) if gradient is None else gradient.contiguous()
        finite = all(bool(torch.isfinite(p.grad).all()) for p in self.parameters if p.grad is not None)
        if value != value or abs(value) == float("inf") or not finite:
            raise _NotFiniteError(f"the loss or its gradient is not finite (loss {value})")
        if not self.curve or value < self.curve[-1]:
            self.curve.append(value)
            self.best = [parameter.detach().clone() for parameter in self.parameters]
            if self.callback is not None:
                self.callback(Progress(self.n_evaluations, value, time.perf_counter() - self.started))
        return value

    def restore(self) -> None:
        """Put the best parameters seen back, and drop the gradients."""
        with torch.no_grad():
            for parameter, best in zip(self.parameters, self.best, strict=True):
                parameter.copy_(best)
                parameter.grad = None


def minimize(
    objective: Callable[[], Tensor],
    parameters: Sequence[Tensor],
    *,
    max_iter: int = 200,
    tol: float = 1e-8,
    history_size: int = 20,
    callback: Callable[[Progress], None] | None = None,
) -> FitReport:
    """Minimize a scalar objective by L-BFGS with a strong Wolfe line search; leaves the best point seen.

    ``torch.optim.LBFGS`` can raise from its line search, and can return from a failed one at a worse point.
    Here every evaluation is remembered, and a failed run is restarted from the best point with a halved
    first step, at most three times.

    Parameters
    ----------
    objective : callable
        Returns the loss, a scalar tensor, at the present values of ``parameters``.
    parameters : sequence of Tensor
        Leaf tensors, changed in place.
    max_iter : int, default=200
        Largest number of L-BFGS iterations, over all restarts.
    tol : float, default=1e-8
        Stop when the largest gradient entry, or the change of the loss, is below it: scale the objective
        so that one unit matters.
    history_size : int, default=20
        Pairs of steps and gradient changes kept.
    callback : callable, optional
        Called with a :class:`Progress` after each improvement.

    Returns
    -------
    FitReport
        Its loss is never above that of the start.

    Raises
    ------
    ValueError
        If the loss or its gradient is not finite at the start.
    """
    point = _BestPoint(objective, parameters, callback)
    try:
        point()
    except _FAILURES as error:
        raise ValueError(f"The optimization cannot start: {error}.") from error
    n_iter, step_size, reason = 0, 1.0, ""
    for _ in range(4):
        optimizer = torch.optim.LBFGS(
            list(parameters),
            lr=step_size,
            max_iter=max_iter - n_iter,
            max_eval=2 * (max_iter - n_iter) + 20,
            tolerance_grad=tol,
            tolerance_change=tol * max(1.0, abs(point.curve[0])) * 1e-2,
            history_size=history_size,
            line_search_fn="strong_wolfe",
        )
        reason = ""
        try:
            optimizer.step(point)
        except _FAILURES as error:
            reason = str(error) or type(error).__name__
        n_iter += max(1, optimizer.state[optimizer._params[0]].get("n_iter", 0))
        point.restore()
        if not reason or n_iter >= max_iter:
            break
        step_size /= 2
    converged = not reason and n_iter < max_iter
    message = reason or ("converged" if converged else f"stopped at max_iter={max_iter} iterations")
    return FitReport(point.curve[-1], tuple(point.curve), n_iter, converged, message)
