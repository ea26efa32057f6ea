"""L-BFGS that never loses its best point, for one objective and for many small ones side by side; Fisher scoring."""

from torch_pbd.optim.batch import BatchReport, FitReport, Progress, Status, first_failure, minimize_batch
from torch_pbd.optim.descent import minimize, minimize_scoring

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
