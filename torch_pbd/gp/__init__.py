"""Batches of independent Gaussian processes over the same inputs: eq. (3) to (6), and their evidence."""

from torch_pbd.gp.evidence import EvidenceSearch, negative_log_evidence
from torch_pbd.gp.latent import LatentGP, LatentValues, condition
from torch_pbd.gp.observations import (
    Hyperparameters,
    Observations,
    longest_within,
    merge_observations,
    neighbourhoods,
    resolved_length_scale,
    spacing,
)
from torch_pbd.gp.search import fit_hyperparameters, fit_together

__all__ = [
    "EvidenceSearch",
    "Hyperparameters",
    "LatentGP",
    "LatentValues",
    "Observations",
    "condition",
    "fit_hyperparameters",
    "fit_together",
    "longest_within",
    "merge_observations",
    "negative_log_evidence",
    "neighbourhoods",
    "resolved_length_scale",
    "spacing",
]
