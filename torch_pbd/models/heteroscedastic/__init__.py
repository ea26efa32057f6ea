"""Mean and covariance by latent Gaussian processes that are integrated out: the recommended model."""

from torch_pbd.models.heteroscedastic.families import Families
from torch_pbd.models.heteroscedastic.fit import HeteroscedasticFit, fit_heteroscedastic
from torch_pbd.models.heteroscedastic.mean import mean_start
from torch_pbd.models.heteroscedastic.module import HeteroscedasticModel
from torch_pbd.models.heteroscedastic.processes import ProcessFamily, SearchOptions
from torch_pbd.models.heteroscedastic.residuals import are_copies

__all__ = [
    "Families",
    "HeteroscedasticFit",
    "HeteroscedasticModel",
    "ProcessFamily",
    "SearchOptions",
    "are_copies",
    "fit_heteroscedastic",
    "mean_start",
]
