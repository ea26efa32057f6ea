"""Steps of a turn: the mean under the noise by generalized least squares, and the covariance of the residuals.

Also where the mean begins if a first one does not follow the data: at what the evidence finds together with the noise.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import pad

from torch_pbd.gp.evidence import EvidenceSearch, negative_log_evidence
from torch_pbd.gp.observations import Hyperparameters, Observations, resolved_length_scale
from torch_pbd.gp.search import fit_together
from torch_pbd.linalg import triangular_inverse
from torch_pbd.models.heteroscedastic.log_variance import LEAST_SQUARE, Squares, fit_log_variance, log_variance_evidence
from torch_pbd.models.heteroscedastic.posterior import LatentCovariance, LatentMean
from torch_pbd.models.heteroscedastic.processes import CLEAR, FixedFeatures, Gradient, ProcessFamily, inducing_inputs
from torch_pbd.models.heteroscedastic.regression import (
    LinearEvidence,
    MixedResponses,
    NoiseCorrelation,
    Regression,
    whiten,
    whiten_vjp,
)
from torch_pbd.models.heteroscedastic.search import COEFFICIENT, Search, SearchOptions
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

# Sweeps over log variances and coefficients, and how many search the coefficients' hyperparameters: one of each more
# gains less than a nat.
_SWEEPS, _SEARCHES = 2, 1
# An input with at least so many degrees of freedom left gives a conditional variance by itself.
_ENOUGH_DEGREES = 2.0


def fit_mean(
    search: Search, rows: TrainingSet, noise_tril: Float[Tensor, "n d d"], noise: NoiseCorrelation | None
) -> LatentMean:
    """Posterior given the means of rows at the inputs; of a row the noise has the factor ``noise_tril``.

    Hyperparameters are chosen for each output by its own evidence, as if its noise were independent of the others';
    the posterior is that of all outputs together.
    """
    means, counts = rows.means, rows.counts
    # One output: its mean over the deviation of its noise is features times weights, and noise of unit variance. In the
    # search alone no noise is less than _NONE. Rounding of kernels, 1e-16, changes the evidence of n inputs by about n
    # 1e-16 over the variance of the noise: of 1e-12 by .02 nats, and rounding of y then led to other length scales.
    scale = (counts.sqrt()[:, None] / noise_tril.square().sum(-1).sqrt()).clamp_max(1.0 / _NONE).mT.unsqueeze(-1)
    whitener = torch.ones_like(scale) if noise is None else noise.whitener
    response = whiten(whitener, scale * means.mT.unsqueeze(-1)).squeeze(-1)
    information = whiten(whitener.square(), scale.square()).sum((-2, -1))
    fixed = FixedFeatures(search.family, rows.inputs)

    def evidence(theta: Tensor, outputs: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        design, vjp = fixed.design_vjp(theta, information[outputs])
        its_whitener, its_scale, its_response = whitener[outputs], scale[outputs], response[outputs]
        whitened = whiten(its_whitener, its_scale * design)
        linear = LinearEvidence.fit(whitened, its_response)
        return linear.value, lambda: vjp(its_scale * whiten_vjp(its_whitener, linear.gradient(whitened, its_response)))

    processes = search.family.prepared(search.run(evidence))
    # All outputs: sqrt(count) inv(T) mean, with T the factor of the noise, has independent entries at an input.
    whitening = counts.sqrt()[:, None, None] * triangular_inverse(noise_tril)
    responses = MixedResponses(whitening, (whitening @ means.unsqueeze(-1)).squeeze(-1), whitener)
    return LatentMean(processes, responses.weights(processes(rows.inputs)))


def mean_start(
    rows: TrainingSet, first: LatentMean, noise_tril: Float[Tensor, "d d"], options: SearchOptions
) -> tuple[Search, Float[Tensor, "d d"], TrainingSet] | None:
    """Start where inducing inputs are too few for the means at the inputs, or their noise was taken for too large.

    A search that holds the hyperparameters found, on the inducing inputs that they need; the factor of a row's noise;
    and the rows, at as many inputs as are needed. None unless the evidence is clearly higher, of any output, than that
    of the ``first`` one under its noise. Residuals that are not white by chance, or under noise that is louder in
    places, are no reason to begin here: these hyperparameters stay, and noise that depends on the input would have led
    to others.
    """
    training = rows.merged(MOST_INPUTS)
    rows_at_input = training.counts.mean()
    observations = Observations(training.inputs, training.means.mT.contiguous(), training.counts / rows_at_input)
    noise = pooled_tril(rows).norm(dim=1) / rows_at_input.sqrt()
    # Rows that repeat inputs show the noise, unless they are copies.
    known = noise if 2 * len(rows.inputs) <= len(rows.x) and bool((noise > _LEAST_NOISE).all()) else None
    least = resolved_length_scale(training.inputs)
    for shortest in (max(_CHEAP, least), least):
        search = EvidenceSearch(length_scale_bounds=(shortest, _LONGEST), noise_scale=known)
        found, loss, *_ = fit_together([(observations, search)])[0]
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
    needed = (CLEAR / float(found.length_scale.min())) ** training.inputs.shape[1]
    needed = math.ceil(min(needed, len(training.inputs)))
    inducing = inducing_inputs(training.inputs, max(len(family.inducing), min(needed, _TOGETHER // n_outputs)))
    family = replace(family, inducing=inducing, exact=len(inducing) == len(rows.inputs))
    held = Search(family, n_outputs, options, family.theta_of(found.length_scale, found.amplitude))
    return held, (noise_scale * rows_at_input.sqrt()).diag(), rows.merged(_MOST_ROWS // n_outputs)


class CovarianceSearch:
    """Searches of the hyperparameters of the log variances, and of the coefficients of outputs 1, 2, ..., if any.

    These are on the features of the log variances.
    """

    def __init__(self, log_variance: ProcessFamily, n_outputs: int, options: SearchOptions) -> None:
        self.log_variance = Search(log_variance, n_outputs, options)
        self.coefficient_family = replace(log_variance, **COEFFICIENT)
        self.coefficients = [Search(self.coefficient_family, 1, options) for _ in range(1, n_outputs)]


_FitRow = Callable[[int, Regression], tuple[Tensor, Tensor, Tensor, Tensor | float]]
"""Features (n, p) of the coefficients of output i, mean and covariance of their weights, and the divergence."""


def fit_covariance(
    search: CovarianceSearch,
    inputs: Float[Tensor, "n e"],
    scatter: Float[Tensor, "n d d"],
    degrees: Float[Tensor, "d n"],
    noise: NoiseCorrelation | None,
    previous: LatentCovariance | None,
    *,
    cautious: bool = False,
) -> tuple[LatentCovariance, float]:
    """Posterior of the factor, and the log evidence in nats, by coordinate ascent.

    With w_i = sum over j < i of phi_ij e_j + exp(l_i / 2) e_i: the log variances l given the expected squares of the
    residuals from the regressions, and the coefficients phi given the expected precisions E[exp(-l)], by turns. Each
    raises the same lower bound of the evidence where rows are independent. Scatters are sums of the outer products of
    residuals at each input, whose pooled covariance is the unit matrix; their degrees of freedom are of each output
    given those before it. A ``cautious`` fit, where a part of the rows counts, sweeps once.
    """
    # An output that is constant is noise of the least variance too where later ones are regressed on it: to zeros
    # any coefficient would fit, and its uncertainty would count as their variance.
    scatter = scatter + LEAST_SQUARE * torch.diag_embed(degrees.mT)
    fixed = FixedFeatures(search.log_variance.family, inputs)
    in_row = FixedFeatures(search.coefficient_family, inputs)
    whole = Squares(scatter.diagonal(dim1=1, dim2=2).mT, degrees, noise)
    near, following = None, whole
    if previous is not None:
        near = previous.log_variance_at(inputs)[0].mT
        rows = zip(previous.rows(inputs), previous.coefficients, strict=True)
        known = [(features, mean, root @ root.mT, 0.0) for features, (mean, root) in rows]
        _, following, _ = _regress(scatter, whole, near, torch.exp(-near), lambda i, _: known[i - 1])
    for sweep in range(_SWEEPS if scatter.shape[1] > 1 and not cautious else 1):
        squares = following
        near = (squares.log_pooled if near is None else near).clone()
        theta = search.log_variance.run(log_variance_evidence(fixed, squares, near))
        design, _ = fixed.design_vjp(theta, squares.information)
        log_variance = fit_log_variance(squares, design, near)
        near, posterior = log_variance.location, log_variance.posterior
        # E[exp(-l)] of a normal l: its mean and half its variance.
        precision = torch.exp(-near + 0.5 * ((design @ posterior.covariance) * design).sum(-1))
        searched = partial(_searched_row, search.coefficients, in_row, anew=sweep < _SEARCHES)
        regressions, following, divergence = _regress(scatter, whole, near, precision, searched)
        evidence = float(posterior.value.sum()) - divergence
    # The weights of all features, where the searches took only those that carry something.
    log_variances = search.log_variance.family.prepared(theta)
    weights = fit_log_variance(squares, log_variances(inputs), log_variance.location).posterior.weights
    thetas = [each.theta for each in search.coefficients if each.theta is not None]
    processes = search.coefficient_family.prepared(torch.cat([theta[:0], *thetas]))
    of_regressions = zip(regressions, processes(inputs).unsqueeze(1), strict=True)
    coefficients = [regression.weights(features) for regression, features in of_regressions]
    return LatentCovariance(log_variances, weights, processes, coefficients), evidence


def _regress(
    scatter: Tensor, whole: Squares, location: Tensor, precision: Tensor, fit_row: _FitRow
) -> tuple[list[Regression], Squares, float]:
    """Regressions of one output after another on those before it, of log variances and precisions (d, n) as known.

    With the squares of their residuals, which are the ``whole`` ones of the first output, and the divergence of their
    coefficients from the prior. Where samples are correlated and enough at an input the squares are of the regression
    there by itself: an error of the coefficients' processes, as smooth as the demonstrations, would else count as
    residual.
    """
    deviation, noise = torch.exp(0.5 * location), whole.noise
    whitener = torch.ones_like(deviation).unsqueeze(-1) if noise is None else noise.whitener
    tril, regressions, divergence = deviation[0][:, None, None], [], 0.0
    totals, degrees = list(whole.total), list(whole.degrees)
    for i in range(1, len(location)):
        regression = Regression.standardize(scatter[:, : i + 1, : i + 1], tril, precision[i], whitener[i])
        features, mean, covariance, own_divergence = fit_row(i, regression)
        regressions.append(regression)
        divergence += float(own_divergence)
        totals[i] = regression.expected_squares(features, mean, covariance)
        if noise is not None:
            local = degrees[i] - i * noise.copies[i]
            enough = local >= _ENOUGH_DEGREES * noise.copies[i]
            totals[i] = torch.where(enough, regression.local_squares(), totals[i])
            degrees[i] = torch.where(enough, local, degrees[i])
        # The factor of outputs 0, ..., i, on which the next one is regressed.
        row = torch.cat([features @ mean.reshape(i, -1).mT, deviation[i][:, None]], dim=1)
        tril = torch.cat([pad(tril, (0, 1)), row.unsqueeze(1)], dim=1)
    return regressions, Squares(torch.stack(totals), torch.stack(degrees), noise), divergence


def _searched_row(
    searches: list[Search], fixed: FixedFeatures, i: int, regression: Regression, *, anew: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coefficients of output i, their hyperparameters searched anew or kept."""
    search, information = searches[i - 1], regression.mixing.square().sum()[None]

    def evidence(theta: Tensor, rows: Tensor) -> tuple[Tensor, Gradient]:
        design, vjp = fixed.design_vjp(theta, information[rows])
        linear = regression.fit(design.unsqueeze(1))
        return linear.value, lambda: vjp(regression.gradient(linear, design))

    theta = search.run(evidence) if anew or search.theta is None else search.theta
    design, _ = fixed.design_vjp(theta, information)
    linear = regression.fit(design.unsqueeze(1))
    return design[0], linear.mean[0], linear.covariance[0], linear.divergence_from_prior()
