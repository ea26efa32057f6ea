"""L-BFGS that never loses its best point, for one objective and for many small ones side by side; Fisher scoring."""

from torch_pbd.optim.batch import BatchReport, by_autograd, first_failure, minimize_batch
from torch_pbd.optim.journal import Entry, Journal, Record, State, recorded
from torch_pbd.optim.lbfgs import FAILURES, FitReport, Progress, minimize
from torch_pbd.optim.scoring import minimize_scoring

__all__ = [
    "FAILURES",
    "BatchReport",
    "Entry",
    "FitReport",
    "Journal",
    "Progress",
    "Record",
    "State",
    "by_autograd",
    "first_failure",
    "minimize",
    "minimize_batch",
    "minimize_scoring",
    "recorded",
]
