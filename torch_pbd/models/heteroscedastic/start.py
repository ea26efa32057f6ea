"""Where the mean begins if it does not follow the data: hyperparameters and noise that the evidence finds together."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp import EvidenceSearch, Observations, fit_together
from torch_pbd.gp.inducing import inducing_inputs
from torch_pbd.gp.neighbourhoods import resolved_length_scale
from torch_pbd.models.heteroscedastic.processes import CLEAR, ProcessFamily
from torch_pbd.models.training import TrainingSet

# Inputs that a fast mean is told apart at, and inducing inputs of all outputs together: a fit of them takes seconds.
MOST_CORRELATED = 1024
"""Inputs of a fast mean, where rows of a demonstration are correlated."""
_MOST_INPUTS, _MOST_ROWS, _TOGETHER = 1024, 16384, 2048
# Length scale down to which a search takes a few matrices of 168 rows; and noise, of outputs of unit variance, below
# which nothing is left to be found with shorter ones: a smooth signal's residual is never white.
_CHEAP, _NONE = 0.025, 1e-4
_LONGEST = 10.0  # length scale, in ranges of the inputs: a trend
MUCH_LESS = 0.25
"""Share of the variance that was taken for noise, below which as residual it was not."""


@dataclass(frozen=True)
class MeanStart:
    """Family on as many inducing inputs as it needs, hyperparameters, noise, and the inputs to fit at."""

    family: ProcessFamily
    theta: Float[Tensor, "d q"]
    noise_scale: Float[Tensor, " d"]
    """Standard deviation of a row."""
    training: TrainingSet

    @classmethod
    def of(cls, rows: TrainingSet, family: ProcessFamily, most: int | None) -> "MeanStart":
        """What the evidence of the means at the inputs finds, with the noise.

        ``most`` bounds the number of inducing inputs, where the user does.
        """
        training = rows.merged(_MOST_INPUTS)
        weights = training.counts / training.counts.mean()
        observations = Observations(training.inputs, training.means().mT.contiguous(), weights)
        least = resolved_length_scale(training.inputs)
        for shortest in (max(_CHEAP, least), least):
            search = EvidenceSearch(length_scale_bounds=(shortest, _LONGEST))
            found = fit_together([(observations, search)])[0].hyperparameters
            noise_scale = found.amplitude * found.noise_ratio.sqrt()
            if bool((noise_scale < _NONE).all()):
                break
        scale = found.length_scale
        scale = scale.amin(0).expand_as(scale) if family.shared else scale
        n_outputs, n_features = scale.shape
        if most is None:
            needed = math.ceil(min((CLEAR / float(scale.min())) ** n_features, len(training.inputs)))
            most = max(len(family.features.inducing), min(needed, _TOGETHER // n_outputs))
        inducing = inducing_inputs(training.inputs, most)
        features = replace(family.features, inducing=inducing, exact=len(inducing) == len(rows.inputs))
        family = replace(family, features=features)
        noise_scale = noise_scale * training.counts.mean().sqrt()
        return cls(family, family.theta_of(scale, found.amplitude), noise_scale, rows.merged(_MOST_ROWS // n_outputs))
