"""Batches of independent Gaussian processes over the same inputs: eq. (3) to (6), and their evidence."""

from torch_pbd.gp.evidence import (
    EvidenceSearch,
    fit_hyperparameters,
    negative_log_evidence,
)
from torch_pbd.gp.latent import LatentGP, condition
from torch_pbd.gp.latent_values import LatentValues
from torch_pbd.gp.neighbourhoods import merge_observations, neighbourhoods, spacing
from torch_pbd.gp.observations import Hyperparameters, Observations

__all__ = [
    "EvidenceSearch",
    "Hyperparameters",
    "LatentGP",
    "LatentValues",
    "Observations",
    "condition",
    "fit_hyperparameters",
    "merge_observations",
    "negative_log_evidence",
    "neighbourhoods",
    "spacing",
]
