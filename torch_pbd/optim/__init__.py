"""L-BFGS that keeps its best point, for one objective or many small ones in parallel, and Fisher scoring."""

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
