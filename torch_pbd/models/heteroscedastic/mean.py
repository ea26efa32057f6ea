"""Mean by generalized least squares: Gaussian processes under noise whose covariance depends on the input.

Also where it begins if a first mean does not follow the data: at what the evidence finds together with the noise.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp import EvidenceSearch, Hyperparameters, Observations, fit_hyperparameters, negative_log_evidence
from torch_pbd.gp.observations import resolved_length_scale
from torch_pbd.linalg import triangular_inverse
from torch_pbd.models.heteroscedastic.processes import FixedFeatures, Processes, inducing_inputs
from torch_pbd.models.heteroscedastic.regression import LinearEvidence, Weights
from torch_pbd.models.heteroscedastic.search import Gradient, Search, SearchOptions
from torch_pbd.models.training import TrainingSet, pooled_tril

MOST_INPUTS = 1024
"""Inputs that short length scales are searched with, and that correlated rows are fitted at: some seconds."""

_CHUNK = 1024  # rows at a time: bounds the memory
_MOST_ROWS, _TOGETHER = 16384, 2048  # inputs to fit at, and inducing ones, of all outputs together
# Length scale down to which a search takes a few matrices of 168 rows; and noise, of outputs of unit variance, below
# which nothing is left to be found with shorter ones: a smooth signal's residual is never white.
_CHEAP, _NONE = 0.025, 1e-4
_LEAST_NOISE = 3e-5  # with less, kernel matrices are singular
_LONGEST = 10.0  # length scale, in ranges of the inputs: a trend
_CLEARLY = 5.0  # nats: 150 to one. Sound draws gain less than one, signals that were missed 25 and more


@dataclass(frozen=True)
class LatentMean:
    """Posterior of the mean: weights of one output after another."""

    theta: Float[Tensor, "d q"]
    processes: Processes
    weights: Weights

    def at(self, x: Float[Tensor, "n e"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Expected mean at x, and the covariance of its error between the outputs."""
        features = self.processes(x)
        n_outputs, _, size = features.shape
        root = (features @ self.weights.root.reshape(n_outputs, size, -1)).transpose(0, 1)
        unexplained = torch.diag_embed(self.processes.unexplained(features).mT)
        return self._expected(features), root @ root.mT + unexplained

    def expected_at(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Expected mean at x, equal to the bit to that of :meth:`at`."""
        return self._expected(self.processes(x))

    def _expected(self, features: Tensor) -> Float[Tensor, "n d"]:
        return (features @ self.weights.mean.reshape(len(features), -1, 1)).squeeze(-1).mT

    def expected_at_all(self, training: TrainingSet) -> Float[Tensor, "rows d"]:
        """Expected mean of all rows; where they do not repeat inputs a bounded number at a time."""
        if training.repeats_inputs:
            return self.expected_at(training.inputs)[training.index]
        processes = self.processes
        weights = processes.amplitude[:, None] * self.weights.mean.reshape(len(self.theta), -1)
        # Weights of the kernel with the inducing inputs, from those of the features: no equations are solved for
        # each row.
        weights = torch.linalg.solve_triangular(processes.factor.mT, weights.unsqueeze(-1), upper=True)
        return torch.cat([(processes.cross(part) @ weights).squeeze(-1).mT for part in training.x.split(_CHUNK)])


def fit_mean(
    search: Search,
    inputs: Float[Tensor, "n e"],
    means: Float[Tensor, "n d"],
    counts: Float[Tensor, " n"],
    noise_tril: Float[Tensor, "n d d"],
    whitener: Float[Tensor, "d n n"] | None,
) -> LatentMean:
    """Posterior given means of ``counts`` rows, whose noise has the factor ``noise_tril``.

    Hyperparameters are chosen for each output by its own evidence, as if its noise were independent of the others';
    the posterior is that of all outputs together. ``whitener`` makes the means at different inputs independent.
    """
    # One output: its mean over the deviation of its noise is features times weights, and noise of unit variance. In the
    # search alone no noise is less than _NONE. Rounding of kernels, 1e-16, changes the evidence of n inputs by about n
    # 1e-16 over the variance of the noise: of 1e-12 by .02 nats, and rounding of y then led to other length scales.
    scale = (counts.sqrt()[:, None] / noise_tril.square().sum(-1).sqrt()).clamp_max(1.0 / _NONE).mT.unsqueeze(-1)
    noise_whitener = scale if whitener is None else whitener * scale.mT
    response = _times(noise_whitener, means.mT.unsqueeze(-1)).squeeze(-1)
    information = noise_whitener.square().sum((-2, -1))
    family, fixed = search.family, FixedFeatures(search.family, inputs)

    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        design, vjp = family.design_vjp(fixed, theta, information[rows])
        chosen, its_response = noise_whitener[rows], response[rows]
        whitened = _times(chosen, design)
        linear = LinearEvidence.fit(whitened, its_response)
        transposed = chosen if whitener is None else chosen.mT
        return linear.value, lambda: vjp(_times(transposed, linear.gradient(whitened, its_response)))

    theta = search.run(evidence, len(means))
    # All outputs: sqrt(count) inv(T) mean, with T the factor of the noise, has independent entries at an input.
    processes = family.prepared(theta)
    whitening = counts.sqrt()[:, None, None] * triangular_inverse(noise_tril)
    design = torch.einsum("nij,jnp->nijp", whitening, processes(inputs)).flatten(2)
    response = (whitening @ means.unsqueeze(-1)).squeeze(-1)
    if whitener is not None:
        design = torch.einsum("imn,niq->miq", whitener, design)
        response = torch.einsum("imn,ni->mi", whitener, response)
    return LatentMean(theta, processes, LinearEvidence.fit(design.flatten(0, 1), response.flatten()).weights)


def _times(whitener: Tensor, values: Tensor) -> Tensor:
    """Whitened values: by a matrix, or by its diagonal (..., n, 1) where it has no more."""
    return whitener * values if whitener.shape[-1] == 1 else whitener @ values


class MeanStart(NamedTuple):
    """Beginning of a mean."""

    search: Search
    """Holds the hyperparameters that were found, on the inducing inputs that they need."""
    noise_tril: Float[Tensor, "d d"]
    """Factor of the noise of a row, the same everywhere."""
    rows: TrainingSet
    """Rows at as many inputs as are needed."""


def mean_start(
    rows: TrainingSet, first: LatentMean, noise_tril: Float[Tensor, "d d"], options: SearchOptions
) -> MeanStart | None:
    """Start where inducing inputs are too few for the means at the inputs, or their noise was taken for too large.

    None unless the evidence is clearly higher, of any output, than that of the ``first`` one under its noise. Residuals
    that are not white by chance, or under noise that is louder in places, are no reason to begin here: these
    hyperparameters stay, and noise that depends on the input would have led to others.
    """
    training = rows.merged(MOST_INPUTS)
    rows_at_input = training.counts.mean()
    observations = Observations(training.inputs, training.means().mT.contiguous(), training.counts / rows_at_input)
    noise = pooled_tril(rows).norm(dim=1) / rows_at_input.sqrt()
    # Rows that repeat inputs show the noise, unless they are copies.
    known = noise if 2 * len(rows.inputs) <= len(rows.x) and bool((noise > _LEAST_NOISE).all()) else None
    least = resolved_length_scale(training.inputs)
    for shortest in (max(_CHEAP, least), least):
        search = EvidenceSearch(length_scale_bounds=(shortest, _LONGEST), noise_scale=known)
        found, loss, _ = fit_hyperparameters(observations, search)
        noise_scale = found.amplitude * found.noise_ratio.sqrt()
        if bool((noise_scale < _NONE).all()):
            break
    processes, family, n_outputs = first.processes, first.processes.family, len(loss)
    noise_ratio = noise_tril.square().sum(1) / rows_at_input / processes.amplitude.square()
    before = Hyperparameters(processes.length_scale, processes.amplitude, noise_ratio)
    # What is too smooth to be evaluated is NaN, and no mean to keep.
    if bool((negative_log_evidence(observations, before, family.kernel) - loss < _CLEARLY).all()):
        return None
    # As many inducing inputs as resolve the shortest length scale with room to spare.
    needed = math.ceil(min(family.n_needed(float(found.length_scale.min())), len(training.inputs)))
    inducing = inducing_inputs(training.inputs, max(len(family.inducing), min(needed, _TOGETHER // n_outputs)))
    family = replace(family, inducing=inducing, exact=len(inducing) == len(rows.inputs))
    held = Search(family, n_outputs, options, family.theta_of(found.length_scale, found.amplitude), held=True)
    return MeanStart(held, (noise_scale * rows_at_input.sqrt()).diag(), rows.merged(_MOST_ROWS // n_outputs))
