"""L-BFGS for one objective and BFGS for many small ones side by side; neither loses its best point."""

from torch_pbd.optim.batch import BatchReport, minimize_batch, minimize_batch_with_gradient
from torch_pbd.optim.lbfgs import FitReport, Progress, minimize

__all__ = ["BatchReport", "FitReport", "Progress", "minimize", "minimize_batch", "minimize_batch_with_gradient"]
