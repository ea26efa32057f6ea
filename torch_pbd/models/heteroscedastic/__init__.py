"""Mean and covariance by latent Gaussian processes that are integrated out: the recommended model."""

from torch_pbd.models.heteroscedastic.fit import HeteroscedasticFit, fit_heteroscedastic
from torch_pbd.models.heteroscedastic.module import HeteroscedasticModel
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.residuals import are_copies
from torch_pbd.models.heteroscedastic.search import (
    Families,
    SearchOptions,
    candidate_families,
    check_memory,
    inducing_sizes,
)

__all__ = [
    "Families",
    "HeteroscedasticFit",
    "HeteroscedasticModel",
    "ProcessFamily",
    "SearchOptions",
    "are_copies",
    "candidate_families",
    "check_memory",
    "fit_heteroscedastic",
    "inducing_sizes",
]
