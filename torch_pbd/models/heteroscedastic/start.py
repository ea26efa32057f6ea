"""Where the mean begins if the first one does not follow the data: what the evidence finds together with the noise."""

import math
from dataclasses import replace

from torch import Tensor

from torch_pbd.gp import EvidenceSearch, Observations, fit_together
from torch_pbd.gp.inducing import inducing_inputs
from torch_pbd.gp.neighbourhoods import resolved_length_scale
from torch_pbd.models.heteroscedastic.processes import CLEAR, ProcessFamily
from torch_pbd.models.heteroscedastic.search import Search, SearchOptions
from torch_pbd.models.training import TrainingSet, pooled_tril

MOST_INPUTS = 1024
"""Inputs that short length scales are searched with, and that correlated rows are fitted at: some seconds."""

_MOST_ROWS, _TOGETHER = 16384, 2048  # inputs to fit at, and inducing ones, of all outputs together
# Length scale down to which a search takes a few matrices of 168 rows; and noise, of outputs of unit variance, below
# which nothing is left to be found with shorter ones: a smooth signal's residual is never white.
_CHEAP, _NONE = 0.025, 1e-4
_LEAST_NOISE = 3e-5  # with less, kernel matrices are singular
_LONGEST = 10.0  # length scale, in ranges of the inputs: a trend


def mean_start(rows: TrainingSet, family: ProcessFamily, options: SearchOptions) -> tuple[Search, Tensor, TrainingSet]:
    """Start where ``family`` is too coarse for the means at the inputs, or their noise was taken for too large.

    That is hyperparameters found, on the inducing inputs that they need; the factor (d, d) of the noise of a row; and
    the rows at as many inputs as are needed.
    """
    training = rows.merged(MOST_INPUTS)
    rows_at_input = training.counts.mean()
    observations = Observations(training.inputs, training.means().mT.contiguous(), training.counts / rows_at_input)
    noise = pooled_tril(rows).norm(dim=1) / rows_at_input.sqrt()
    # Rows that repeat inputs tell the noise, unless they are copies.
    known = noise if 2 * len(rows.inputs) <= len(rows.x) and bool((noise > _LEAST_NOISE).all()) else None
    least = resolved_length_scale(training.inputs)
    for shortest in (max(_CHEAP, least), least):
        bounds = (shortest, _LONGEST)
        found = fit_together([(observations, EvidenceSearch(length_scale_bounds=bounds, noise_scale=known))])[
            0
        ].hyperparameters
        noise_scale = found.amplitude * found.noise_ratio.sqrt()
        if bool((noise_scale < _NONE).all()):
            break
    scale = found.length_scale.amin(0).expand_as(found.length_scale) if family.shared else found.length_scale
    n_outputs, n_features = scale.shape
    needed = math.ceil(min((CLEAR / float(scale.min())) ** n_features, len(training.inputs)))
    inducing = inducing_inputs(training.inputs, max(len(family.features.inducing), min(needed, _TOGETHER // n_outputs)))
    exact = len(inducing) == len(rows.inputs)
    family = replace(family, features=replace(family.features, inducing=inducing, exact=exact))
    search = Search(family, n_outputs, n_features, options, family.theta_of(scale, found.amplitude), held=True)
    return search, (noise_scale * rows_at_input.sqrt()).diag(), rows.merged(_MOST_ROWS // n_outputs)
