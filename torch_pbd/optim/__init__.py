"""L-BFGS that never loses its best point, for one objective and for many small ones side by side; Fisher scoring."""

from torch_pbd.optim.batch import BatchReport, minimize_batch
from torch_pbd.optim.lbfgs import minimize
from torch_pbd.optim.report import FitReport, Progress, Status, first_failure
from torch_pbd.optim.scoring import minimize_scoring

__all__ = [
    "BatchReport",
    "FitReport",
    "Progress",
    "Status",
    "first_failure",
    "minimize",
    "minimize_batch",
    "minimize_scoring",
]
