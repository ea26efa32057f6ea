"""Where the mean begins if it does not follow the data: hyperparameters and noise that the evidence finds together."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
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
_LAGS = 3
_NOT_WHITE = 21.1  # 0.9999 quantile of the chi-squared distribution of three degrees of freedom
# What residuals of K demonstrations have in common, of their variance, that is no chance: the mean square of means of
# K would be four times what it should be. Smooth demonstrations have few independent places along the input.
_MOST_COMMON, _COMMON = 0.5, 3.0
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


def is_signal(
    whitened: Float[Tensor, "rows d"], training: TrainingSet, group: Int64[Tensor, " rows"] | None
) -> Bool[Tensor, " d"]:
    """Whether residuals of unit variance have something in common along the inputs: not white, and of all rows there.

    Rows of one demonstration may be alike; what tells are those of others at an input and at the next.
    """
    order = training.inputs[:, 0].argsort()
    place = order.argsort()[training.index]
    counts = training.counts[order][:, None]
    total = torch.zeros_like(training.means()).index_add_(0, place, whitened)
    value = total / counts.sqrt()
    # The square of each sum of products over that of their squares, whatever the variance: chi-squared, of white noise.
    products = [value[lag:] * value[: len(value) - lag] for lag in range(1, _LAGS + 1)]
    share = [each.sum(0).square() / each.square().sum(0).clamp_min(1e-300) for each in products]
    coloured = torch.stack(share).sum(0) > _NOT_WHITE
    if group is None:
        own, own_counts, n_demos = whitened.square().sum(0), counts.sum(), float(counts.mean())
        common, pairs = total.square().sum(0) - own, counts.square().sum() - own_counts
    else:
        n_demos = int(group.max()) + 1
        both = torch.cat([whitened, torch.ones_like(whitened[:, :1])], dim=1)
        each = both.new_zeros(n_demos * len(counts), both.shape[1])
        each = each.index_add_(0, group * len(counts) + place, both).reshape(n_demos, len(counts), -1)
        every = each.sum(0)
        alike = every.square().sum(0) - each.square().sum((0, 1))
        alike = alike + 2.0 * ((every[1:] * every[:-1]).sum(0) - (each[:, 1:] * each[:, :-1]).sum((0, 1)))
        common, pairs = alike[:-1], alike[-1]
    if not bool(pairs > 0):
        return coloured
    variance = whitened.square().mean(0).clamp_min(1e-300)
    return coloured & (common / pairs > variance * min(_MOST_COMMON, _COMMON / max(n_demos - 1.0, 1e-9)))
