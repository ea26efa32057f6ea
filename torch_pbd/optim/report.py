"""How far an optimization is, and how it ended."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import Enum

FAILURES = (ArithmeticError, ValueError, RuntimeError, IndexError)
"""Exceptions of an evaluation at a bad point: Cholesky and eigenvalues, overflow. Others are mistakes, passed on."""


class Status(Enum):
    """How an optimization ended; the value is the phrase for it."""

    CONVERGED = "converged"
    MAX_ITER = "stopped at max_iter iterations"
    MAX_EVALUATIONS = "stopped at the most evaluations for max_iter iterations"
    LINE_SEARCH_FAILED = "no step lowers the loss, though its slope says so"
    NOT_FINITE = "the loss or its gradient is not finite"

    @property
    def is_limit(self) -> bool:
        """Whether more iterations would have gone on."""
        return self in (Status.MAX_ITER, Status.MAX_EVALUATIONS)


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
    """How an optimization ended, and what it came to."""

    loss: float
    loss_curve: tuple[float, ...]
    """Best loss so far, at each evaluation that improved it; the first is the loss at the start."""
    n_iter: int
    status: Status
    detail: str = ""
    """Message of an exception, or name of a search, where the status alone does not tell."""

    @property
    def converged(self) -> bool:
        """Whether it ended by itself."""
        return self.status is Status.CONVERGED

    @property
    def message(self) -> str:
        """How it ended, in words."""
        return self.detail or self.status.value

    def after(self, other: "FitReport", name: str) -> "FitReport":
        """Report with the status of the optimization before it, of this name, where that has not converged."""
        if other.converged or not self.converged:
            return self
        return replace(self, status=other.status, detail=f"{name}: {other.message}")


class BestSoFar:
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
