"""Where the mean begins if the first one does not follow the data: what the evidence finds together with the noise."""

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp import EvidenceSearch, Hyperparameters, Observations, fit_hyperparameters, negative_log_evidence
from torch_pbd.gp.inducing import inducing_inputs
from torch_pbd.gp.neighbourhoods import resolved_length_scale
from torch_pbd.models.heteroscedastic.mean import LatentMean
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
_CLEARLY = 5.0  # nats: 150 to one. Sound draws gain less than one, signals that were missed 25 and more


@dataclass(frozen=True)
class MeanStart:
    """Where a mean begins, and the evidence for it under noise that is the same everywhere."""

    search: Search
    """Holds the hyperparameters that were found, on the inducing inputs that they need."""
    noise_tril: Float[Tensor, "d d"]
    """Factor of the noise of a row."""
    rows: TrainingSet
    """At as many inputs as are needed."""
    observations: Observations
    loss: Float[Tensor, " d"]
    """Negative log evidence, in nats."""

    def improves(self, mean: LatentMean, noise_tril: Float[Tensor, "d d"]) -> bool:
        """Whether the evidence is clearly higher, of any output, than that of ``mean`` under its noise.

        Residuals that are not white by chance, or under noise that is louder in places, are no reason to begin here:
        these hyperparameters stay, and noise that depends on the input would have led to others.
        """
        amplitude, rows_at_input = mean.processes.amplitude, len(self.rows.x) / len(self.observations.inputs)
        noise_ratio = noise_tril.square().sum(1) / rows_at_input / amplitude.square()
        first = Hyperparameters(mean.family.length_scale_of(mean.theta), amplitude, noise_ratio)
        loss = negative_log_evidence(self.observations, first, mean.family.features.kernel)
        return not bool((loss - self.loss < _CLEARLY).all())  # what is too smooth to be evaluated is no mean to keep


def mean_start(rows: TrainingSet, family: ProcessFamily, options: SearchOptions) -> MeanStart:
    """Start where ``family`` is too coarse for the means at the inputs, or their noise was taken for too large."""
    training = rows.merged(MOST_INPUTS)
    rows_at_input = training.counts.mean()
    observations = Observations(training.inputs, training.means().mT.contiguous(), training.counts / rows_at_input)
    noise = pooled_tril(rows).norm(dim=1) / rows_at_input.sqrt()
    # Rows that repeat inputs tell the noise, unless they are copies.
    known = noise if 2 * len(rows.inputs) <= len(rows.x) and bool((noise > _LEAST_NOISE).all()) else None
    least = resolved_length_scale(training.inputs)
    for shortest in (max(_CHEAP, least), least):
        bounds = (shortest, _LONGEST)
        found, loss, _ = fit_hyperparameters(
            observations, EvidenceSearch(length_scale_bounds=bounds, noise_scale=known)
        )
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
    noise_tril = (noise_scale * rows_at_input.sqrt()).diag()
    return MeanStart(search, noise_tril, rows.merged(_MOST_ROWS // n_outputs), observations, loss)
