"""L-BFGS on one objective, which never loses its best point."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from torch_pbd.optim.journal import Record, State

_ITERATIONS = 5  # between two states that are kept
_ATTEMPTS = 4
FAILURES = (ArithmeticError, ValueError, RuntimeError, IndexError)
"""What an evaluation at a bad point raises: Cholesky and eigenvalues, overflow; and the IndexError of torch's strong
Wolfe search, when it brackets no minimum. Others are mistakes, which are not survived."""


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

    def after(self, other: "FitReport", name: str) -> "FitReport":
        """The same report, but not converged where the optimization before it, of this name, is not."""
        if other.converged or not self.converged:
            return self
        return replace(self, converged=False, message=f"{name}: {other.message}")

    def state(self) -> State:
        """As a journal keeps it."""
        return asdict(self) | {"loss_curve": list(self.loss_curve)}

    @classmethod
    def of(cls, state: State) -> "FitReport":
        """The report that :meth:`state` told of."""
        values = {part.name: state[part.name] for part in fields(cls)}
        return cls(**values | {"loss_curve": tuple(state["loss_curve"])})


class _NotFiniteError(ArithmeticError):
    """The loss or its gradient is not a finite number."""


@dataclass
class _BestPoint:
    """The closure L-BFGS calls: evaluates, and remembers the best parameters it has seen."""

    objective: Callable[[], Tensor]
    parameters: Sequence[Tensor]
    callback: Callable[[Progress], None] | None
    n_evaluations: int = 0
    curve: list[float] = field(default_factory=list)
    best: list[Tensor] = field(default_factory=list)
    gradients: list[Tensor] = field(default_factory=list)
    """At the best point, where it was evaluated here."""
    started: float = field(default_factory=time.perf_counter)

    def __call__(self) -> float:
        if self.gradients and all(map(torch.equal, self.parameters, self.best)):
            self._give(self.gradients)
            return self.curve[-1]
        self.n_evaluations += 1
        with torch.enable_grad():
            loss = self.objective()
            found = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        value = float(loss.detach())
        gradients = [
            torch.zeros_like(parameter) if gradient is None else gradient.contiguous()
            for parameter, gradient in zip(self.parameters, found, strict=True)
        ]
        if not math.isfinite(value) or not all(bool(torch.isfinite(gradient).all()) for gradient in gradients):
            raise _NotFiniteError(f"the loss or its gradient is not finite (loss {value})")
        self._give(gradients)
        if not self.curve or value < self.curve[-1]:
            self.curve.append(value)
            self.best = [parameter.detach().clone() for parameter in self.parameters]
            self.gradients = gradients
            if self.callback is not None:
                self.callback(Progress(self.n_evaluations, value, time.perf_counter() - self.started))
        return value

    def _give(self, gradients: Sequence[Tensor]) -> None:
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient.clone()

    def move(self, to: Sequence[Tensor]) -> None:
        """Give the parameters these values, and drop their gradients."""
        with torch.no_grad():
            for parameter, value in zip(self.parameters, to, strict=True):
                parameter.copy_(value)
                parameter.grad = None

    def restore(self) -> None:
        """Put the best parameters seen back."""
        if self.best:
            self.move(self.best)

    def state(self) -> State:
        """What has been seen so far, as a journal keeps it."""
        return {"n_evaluations": self.n_evaluations, "curve": list(self.curve)} | _numbered("best", self.best)

    def resume(self, state: State) -> None:
        """Go on from :meth:`state`."""
        self.n_evaluations, self.curve = state["n_evaluations"], list(state["curve"])
        self.best = [state[f"best.{i}"].to(parameter) for i, parameter in enumerate(self.parameters)]


@dataclass
class _Attempt:
    """Iterations of one ``torch.optim.LBFGS``, a few at a time, so that its memory can be kept between them."""

    number: int
    """Of restarts before it, each of which halved the first step."""
    n_iter: int
    """Iterations of all attempts."""
    most_evaluations: int
    """Of all attempts."""
    optimizer: torch.optim.LBFGS

    @property
    def memory(self) -> dict[str, Any]:
        """What torch keeps between iterations."""
        return self.optimizer.state[self.optimizer._params[0]]

    def advance(self, point: _BestPoint, max_iter: int) -> bool:
        """Some iterations; whether it would go on."""
        (options,), before = self.optimizer.param_groups, self.memory.get("n_iter", 0)
        options["max_iter"] = min(_ITERATIONS, max_iter - self.n_iter)
        options["max_eval"] = self.most_evaluations - point.n_evaluations + 1  # the first is one of before
        try:
            self.optimizer.step(point)
        finally:
            self.n_iter += self.memory.get("n_iter", 0) - before
        return self.memory["n_iter"] - before == options["max_iter"]

    def state(self) -> State:
        """As a journal keeps it."""
        memory = self.memory
        kept: State = {
            "attempt": self.number,
            "n_iter": self.n_iter,
            "most_evaluations": self.most_evaluations,
            "iterations": memory["n_iter"],
        }
        kept |= _numbered("parameter", [parameter.detach() for parameter in self.optimizer._params])
        if "d" in memory:
            kept |= {key: float(memory[key]) for key in ("t", "H_diag", "prev_loss")}
            kept |= {key: memory[key].clone() for key in ("d", "prev_flat_grad")}
            kept |= {key: torch.stack(memory[key]) for key in ("old_dirs", "old_stps", "ro") if memory[key]}
        return kept

    def resume(self, state: State) -> None:
        """Go on from :meth:`state`."""
        parameter, memory = self.optimizer._params[0], self.memory
        self.most_evaluations = state["most_evaluations"]
        memory |= {"n_iter": state["iterations"], "func_evals": 0}
        if "d" in state:
            memory |= {key: state[key] for key in ("t", "H_diag", "prev_loss")}
            memory |= {key: state[key].to(parameter) for key in ("d", "prev_flat_grad")}
            memory |= {
                key: list(state[key].to(parameter).clone().unbind()) if key in state else []
                for key in ("old_dirs", "old_stps", "ro")
            }


def _numbered(name: str, tensors: Sequence[Tensor]) -> dict[str, Tensor]:
    return {f"{name}.{i}": tensor.clone() for i, tensor in enumerate(tensors)}


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
    first step, at most three times. Whatever ends it, be it a mistake in the objective or an interrupt, the parameters
    are left at the best point. Under :func:`~torch_pbd.optim.recorded` it can be gone on from.

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
    record = Record("L-BFGS", *parameters)
    if record.ended:
        point.resume(record.state)
        point.restore()
        return FitReport.of(record.state)
    try:
        report = _run(point, record, _started(point, record.state), max_iter, tol, history_size)
    finally:
        point.restore()
    record.keep(lambda: point.state() | report.state(), ended=True)
    return report


def _started(point: _BestPoint, state: State) -> State:
    """What is known at the start: that of a run that was cut, or nothing once the loss there is."""
    if state:
        point.resume(state)
        return state
    try:
        point()
    except FAILURES as error:
        raise ValueError(f"The optimization cannot start: {error}.") from error
    return {}


def _run(point: _BestPoint, record: Record, state: State, max_iter: int, tol: float, history_size: int) -> FitReport:
    """Attempts until one ends by itself, or ``max_iter`` iterations."""
    n_iter, reason = state.get("n_iter", 0), ""
    for number in range(state.get("attempt", 0), _ATTEMPTS):
        optimizer = torch.optim.LBFGS(
            list(point.parameters),
            lr=0.5**number,
            tolerance_grad=tol,
            tolerance_change=tol * max(1.0, abs(point.curve[0])) * 1e-2,
            history_size=history_size,
            line_search_fn="strong_wolfe",
        )
        attempt = _Attempt(number, n_iter, point.n_evaluations + 2 * (max_iter - n_iter) + 20, optimizer)
        if state:
            point.move([state[f"parameter.{i}"] for i in range(len(point.parameters))])
            attempt.resume(state)
            state = {}
        reason = _ended(attempt, point, record, max_iter)
        n_iter = attempt.n_iter
        point.restore()
        if not reason or n_iter >= max_iter:
            break
    converged = not reason and n_iter < max_iter
    message = reason or ("converged" if converged else f"stopped at max_iter={max_iter} iterations")
    return FitReport(point.curve[-1], tuple(point.curve), n_iter, converged, message)


def _ended(attempt: _Attempt, point: _BestPoint, record: Record, max_iter: int) -> str:
    """Iterate to the end of an attempt; the reason if it failed."""
    try:
        while attempt.advance(point, max_iter) and attempt.n_iter < max_iter:
            record.keep(lambda: point.state() | attempt.state())
    except FAILURES as error:
        return str(error) or type(error).__name__
    if point.n_evaluations >= attempt.most_evaluations:
        return f"stopped after {point.n_evaluations} evaluations, the most for max_iter={max_iter} iterations"
    return ""
