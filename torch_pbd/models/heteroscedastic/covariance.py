"""Covariance by latent processes, the log variances and coefficients of its factor, and their fit to residuals."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.inducing import FixedFeatures
from torch_pbd.models.heteroscedastic.log_variance import (
    LEAST_SQUARE,
    FactorMoments,
    Squares,
    fit_log_variance,
    search_log_variance,
)
from torch_pbd.models.heteroscedastic.processes import Gradient, Processes, ProcessFamily, Search
from torch_pbd.models.heteroscedastic.regression import LinearEvidence, Regression, Weights
from torch_pbd.models.heteroscedastic.residuals import NoiseCorrelation

# Sweeps over log variances and coefficients, and how many search the coefficients' hyperparameters: one of each more
# gains less than a nat.
_SWEEPS, _SEARCHES = 2, 1
# An input with at least so many degrees of freedom left gives a conditional variance by itself.
_ENOUGH_DEGREES = 2.0


@dataclass(frozen=True)
class LatentCovariance:
    """Posterior of the lower factor of a covariance.

    The diagonal is the root of the conditional variances, whose logarithms are d processes; row i below it
    holds the coefficients of output i on the standardized outputs before it, which are i more.
    """

    log_variance_family: ProcessFamily
    coefficient_family: ProcessFamily
    log_variance_theta: Float[Tensor, "d q"]
    log_variance: Weights
    coefficient_theta: Float[Tensor, "d-1 q"]
    coefficients: Sequence[Weights]
    """Weights of one coefficient after another, of outputs 1, 2, ..."""

    @property
    def resolved(self) -> bool:
        """Whether the inducing inputs resolve all length scales with room to spare, or are all the inputs."""
        resolved = self.log_variance_family.resolved(self.log_variance_theta)
        return resolved and self.coefficient_family.resolved(self.coefficient_theta)

    @cached_property
    def log_variances(self) -> Processes:
        """Processes of the logarithms of the conditional variances."""
        return self.log_variance_family.prepared(self.log_variance_theta)

    @cached_property
    def rows(self) -> Processes:
        """Processes of the coefficients: those of one output, of each but the first, share one kernel."""
        return self.coefficient_family.prepared(self.coefficient_theta)

    def log_variance_at_features(
        self, values: Float[Tensor, "d n m"]
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Means and variances of the log variances, from the features of unit variance."""
        features = self.log_variance_family.scaled(values, self.log_variances.amplitude)
        mean = (features @ self.log_variance.mean.unsqueeze(-1)).squeeze(-1).mT
        variance = (features @ self.log_variance.root).square().sum(-1)
        return mean, (variance + self.log_variances.unexplained(features)).mT

    def at(self, x: Float[Tensor, "n e"]) -> FactorMoments:
        """Moments of the entries of the factor at x."""
        return self.at_features(self.log_variances.features(x), self.rows.features(x) if self.coefficients else None)

    def at_features(self, values: Float[Tensor, "d n m"], row_values: Float[Tensor, "d-1 n m"] | None) -> FactorMoments:
        """Moments of the entries, from the features of unit variance of the log variances and of the coefficients."""
        mean, variance = self.log_variance_at_features(values)
        below = torch.zeros(*mean.shape, mean.shape[1]).to(mean)
        below_variance = torch.zeros_like(below)
        if row_values is not None:
            features = self.coefficient_family.scaled(row_values, self.rows.amplitude)
            unexplained = self.rows.unexplained(features)
            rows, variances = [], []
            # Coefficients of one output share their features, and each has a block of the weights.
            for i, weights in enumerate(self.coefficients, start=1):
                pad = (0, mean.shape[1] - i)
                own = features[i - 1]
                rows.append(torch.nn.functional.pad(own @ weights.mean.reshape(i, -1).mT, pad))
                blocks = weights.root.reshape(i, own.shape[1], -1)
                known = (own @ blocks).square().sum(-1).mT
                variances.append(torch.nn.functional.pad(known + unexplained[i - 1, :, None], pad))
            below = torch.stack([below[:, 0], *rows], dim=1)
            below_variance = torch.stack([below_variance[:, 0], *variances], dim=1)
        return FactorMoments(mean, variance, below, below_variance)

    def draw(self, x: Float[Tensor, "n e"], normal: Sequence[Float[Tensor, "*s _"]]) -> Float[Tensor, "*s n d d"]:
        """Factors at x of functions drawn from the posterior, made of standard normal numbers.

        Those of each output's log variance first, and then those of each output's coefficients.
        """
        n_outputs = len(self.log_variance.mean)
        features = self.log_variances(x)
        diagonal = []
        for i in range(n_outputs):
            weights = self.log_variance.mean[i] + normal[i] @ self.log_variance.root[i].mT
            diagonal.append(torch.exp(0.5 * (weights @ features[i].mT)))
        factor = torch.diag_embed(torch.stack(diagonal, dim=-1))
        features = self.rows(x) if self.coefficients else features
        for i, posterior in enumerate(self.coefficients, start=1):
            weights = posterior.mean + normal[n_outputs + i - 1] @ posterior.root.mT
            factor[..., i, :i] = features[i - 1] @ weights.unflatten(-1, (i, -1)).mT
        return factor


@dataclass(frozen=True)
class CovarianceSearches:
    """Searches of the hyperparameters of the log variances, and of the coefficients of outputs 1, 2, ..., if any."""

    log_variance: Search
    coefficients: list[Search]
    coefficient_family: ProcessFamily


@dataclass
class _Sweep:
    """State that a sweep leaves to the next: log variances and expected inverses of the conditional variances, both
    (d, n); the regressions of outputs 1, 2, ..., and the expected squares (n,) of the residuals from each.
    """

    location: Tensor | None = None
    precision: Tensor | None = None
    regressions: list[Regression] = field(default_factory=list)
    expected: list[Tensor] = field(default_factory=list)
    evidence: float = 0.0


def fit_covariance(
    searches: CovarianceSearches,
    inputs: Float[Tensor, "n e"],
    scatter: Float[Tensor, "n d d"],
    degrees: Float[Tensor, "d n"],
    noise: NoiseCorrelation,
    previous: LatentCovariance | None,
    *,
    cautious: bool = False,
) -> tuple[LatentCovariance, float]:
    """Posterior of the factor, and the log evidence in nats, by coordinate ascent.

    With w_i = sum over j < i of phi_ij e_j + exp(l_i / 2) e_i: the log variances l given the expected squares of the
    residuals from the regressions, and the coefficients phi given the expected precisions E[exp(-l)], by turns. Each
    raises the same lower bound of the evidence where rows are independent.

    Parameters
    ----------
    searches : CovarianceSearches
        Searches for processes on the same features.
    scatter : Tensor of shape (n, d, d)
        Sum of the outer products of residuals at each input, whose pooled covariance is the unit matrix.
    degrees : Tensor of shape (d, n)
        Degrees of freedom of the scatters; of each output given those before it.
    noise : NoiseCorrelation
        Correlation of scatters at different inputs.
    previous : LatentCovariance or None
        Where to start.
    cautious : bool, default=False
        Sweep once, where a part of the rows counts.
    """
    # An output that is constant is noise of the least variance too where later ones are regressed on it: to zeros
    # any coefficient would fit, and its uncertainty would count as their variance.
    scatter = scatter + LEAST_SQUARE * torch.diag_embed(degrees.mT)
    fixed = FixedFeatures(searches.log_variance.family.features, inputs)
    last = _Sweep() if previous is None else _from_previous(previous, inputs, scatter, noise)
    for sweep in range(_SWEEPS if scatter.shape[1] > 1 and not cautious else 1):
        squares = _squares(scatter, degrees, noise, last)
        log_variance = search_log_variance(searches.log_variance, fixed, squares, last.location)
        # E[exp(-l)] of a normal l: its mean and half its variance.
        precision = torch.exp(-log_variance.location + 0.5 * log_variance.variance)
        last = _Sweep(log_variance.location, precision, evidence=float(log_variance.evidence.sum()))
        _fit_coefficients(searches.coefficients, fixed, scatter, noise, last, anew=sweep < _SEARCHES)
    return _posterior(searches, inputs, squares, last), last.evidence


def _from_previous(previous: LatentCovariance, inputs: Tensor, scatter: Tensor, noise: NoiseCorrelation) -> _Sweep:
    """State of a posterior, under new scatters."""
    moments = previous.at(inputs)
    tril = moments.tril()
    regressions, expected = [], []
    for i, weights in enumerate(previous.coefficients, start=1):
        known = _regression(scatter, tril[:, :i, :i], noise)
        features = previous.coefficient_family.prepared(previous.coefficient_theta[i - 1 : i])(inputs)[0]
        regressions.append(known)
        explained, unknown = known.squares(features, weights.mean, weights.root @ weights.root.mT)
        expected.append(explained + unknown)
    return _Sweep(moments.log_variance.mT, None, regressions, expected)


def _fit_coefficients(
    searches: list[Search], fixed: FixedFeatures, scatter: Tensor, noise: NoiseCorrelation, state: _Sweep, *, anew: bool
) -> None:
    """Coefficients of one output after another, regressed on those before it; searched for anew or as they are."""
    assert state.location is not None
    assert state.precision is not None
    deviation = torch.exp(0.5 * state.location)
    tril = deviation[0][:, None, None]
    for i, search in enumerate(searches, start=1):
        known = _regression(scatter, tril, noise)
        precision = state.precision[i]
        design, linear = _fit_row(search, fixed, known, precision, anew=anew or search.theta is None)
        features = design[0]
        state.evidence -= float(linear.divergence_from_prior())
        state.regressions.append(known)
        explained, unknown = known.squares(features, linear.mean[0], linear.covariance[0])
        state.expected.append(explained + unknown)
        # The factor of outputs 0, ..., i, on which the next one is regressed.
        row = torch.cat([features @ linear.mean.reshape(i, -1).mT, deviation[i][:, None]], dim=1)
        tril = torch.cat([torch.nn.functional.pad(tril, (0, 1)), row.unsqueeze(1)], dim=1)


def _fit_row(
    search: Search, fixed: FixedFeatures, known: Regression, precision: Tensor, *, anew: bool
) -> tuple[Tensor, LinearEvidence]:
    """Features (1, n, p) and posterior of the weights of the coefficients of one output."""
    information = (precision * known.before.diagonal(dim1=1, dim2=2).sum(-1)).sum()
    latest: list[tuple[Tensor, Tensor, LinearEvidence]] = []

    def evidence(theta: Tensor, _: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        design, vjp = search.family.design_vjp(fixed, theta, information.expand(len(theta)))
        linear = known.fit(design, precision)
        latest[:] = [(theta, design, linear)]
        return linear.value, lambda: vjp(known.gradient(linear, design, precision))

    if anew:
        search.run(evidence, known.response)
    assert search.theta is not None
    if not latest or not torch.equal(latest[0][0], search.theta):
        evidence(search.theta, torch.arange(1))
    return latest[0][1:]


def _squares(scatter: Tensor, degrees: Tensor, noise: NoiseCorrelation, last: _Sweep) -> Squares:
    """Squared residuals of each output from its regression on those before it.

    Where samples are correlated and enough at an input, from the regression there by itself: an error of the
    coefficients' processes, as smooth as the demonstrations, would else count as residual.
    """
    totals, kept = list(scatter.diagonal(dim1=1, dim2=2).mT), list(degrees)
    for i, (known, total) in enumerate(zip(last.regressions, last.expected, strict=True), start=1):
        if noise.copies is not None:
            local = degrees[i] - i * noise.copies[i]
            enough = local >= _ENOUGH_DEGREES * noise.copies[i]
            total, kept[i] = torch.where(enough, known.local_squares(), total), torch.where(enough, local, degrees[i])
        totals[i] = total
    return Squares(torch.stack(totals), torch.stack(kept), noise)


def _posterior(searches: CovarianceSearches, inputs: Tensor, squares: Squares, last: _Sweep) -> LatentCovariance:
    """Posterior of the weights of all features, where the fit took only those that carry something."""
    theta, family = searches.log_variance.theta, searches.log_variance.family
    assert theta is not None
    assert last.precision is not None
    log_variance = fit_log_variance(squares, family.prepared(theta)(inputs), last.location).weights
    coefficients, coefficient_theta = [], theta[:0]
    if last.regressions:
        coefficient_theta = torch.cat([search.theta for search in searches.coefficients if search.theta is not None])
        features = searches.coefficient_family.prepared(coefficient_theta)(inputs)
        for known, own, precision in zip(last.regressions, features, last.precision[1:], strict=True):
            weights = known.fit(own[None], precision).weights()
            coefficients.append(Weights(weights.mean[0], weights.root[0]))
    return LatentCovariance(family, searches.coefficient_family, theta, log_variance, coefficient_theta, coefficients)


def _regression(scatter: Tensor, tril: Tensor, noise: NoiseCorrelation) -> Regression:
    """Regression of the output that follows those of which ``tril`` is the factor."""
    i = tril.shape[-1]
    own = None if noise.square_whitener is None else noise.square_whitener[i]
    return Regression.standardize(scatter[:, : i + 1, : i + 1], tril, own)
