"""Covariance by latent processes, the log variances and coefficients of its factor, and their fit to residuals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torch_pbd.models.heteroscedastic.log_variance import LEAST_SQUARE, Squares, fit_log_variance, search_log_variance
from torch_pbd.models.heteroscedastic.processes import FixedFeatures, Processes
from torch_pbd.models.heteroscedastic.regression import Regression, Weights
from torch_pbd.models.heteroscedastic.residuals import NoiseCorrelation
from torch_pbd.models.heteroscedastic.search import Families, Gradient, Search, SearchOptions

# Sweeps over log variances and coefficients, and how many search the coefficients' hyperparameters: one of each more
# gains less than a nat.
_SWEEPS, _SEARCHES = 2, 1
# An input with at least so many degrees of freedom left gives a conditional variance by itself.
_ENOUGH_DEGREES = 2.0
_LEAST_DEGREES = 3.0  # below two, Student's t has no covariance


@dataclass(frozen=True)
class FactorMoments:
    """Moments of the entries of the lower factor of a covariance at n inputs, as independent normal numbers."""

    log_variance: Float[Tensor, "n d"]
    log_variance_variance: Float[Tensor, "n d"]
    below: Float[Tensor, "n d d"]
    """Entries below the diagonal."""
    below_variance: Float[Tensor, "n d d"]

    @property
    def degrees(self) -> Float[Tensor, " n"]:
        """Squares from which the variances are known, in the mean."""
        return degrees_of_freedom(self.log_variance_variance.mean(-1))

    def tril(self) -> Float[Tensor, "n d d"]:
        """The factor at the means of the latent processes."""
        return self.below + torch.diag_embed(torch.exp(0.5 * self.log_variance))

    def expected_root(self, most: float) -> Float[Tensor, "n d 2*d"]:
        """Root of the expected covariance.

        With a normal log variance of mean l and variance v the deviation's mean is exp(l / 2 + v / 8), and the variance
        exceeds its square by a factor exp(v / 4). No v is above ``most`` in it, as where nothing is known an
        expectation has little to say.
        """
        variance = self.log_variance_variance / (1.0 + self.log_variance_variance / most)
        deviation = torch.exp(0.5 * self.log_variance + 0.125 * variance)
        excess = deviation.square() * torch.expm1(0.25 * variance) + self.below_variance.sum(-1)
        return torch.cat([self.below + torch.diag_embed(deviation), torch.diag_embed(excess.sqrt())], dim=-1)


def degrees_of_freedom(variance: Tensor) -> Tensor:
    """Squares from which a variance is known whose logarithm has this variance.

    It is trigamma(degrees / 2), and ``trigamma(z)`` is taken for ``1 / z + 1 / (2 z^2)``.
    """
    return ((1.0 + (1.0 + 2.0 * variance).sqrt()) / variance).clamp_min(_LEAST_DEGREES)


@dataclass(frozen=True)
class LatentCovariance:
    """Posterior of the lower factor of a covariance.

    The diagonal is the root of the conditional variances, whose logarithms are d processes; row i below it
    holds the coefficients of output i on the standardized outputs before it, which are i more.
    """

    log_variance_theta: Float[Tensor, "d q"]
    log_variances: Processes
    log_variance: Weights
    coefficient_theta: Float[Tensor, "d-1 q"]
    rows: Processes
    """Those of the coefficients of one output, of each but the first, which share one kernel."""
    coefficients: Sequence[Weights]
    """Weights of one coefficient after another, of outputs 1, 2, ..."""

    def log_variance_at(self, x: Float[Tensor, "n e"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Means and variances of the log variances at x."""
        features = self.log_variances(x)
        mean = (features @ self.log_variance.mean.unsqueeze(-1)).squeeze(-1).mT
        variance = (features @ self.log_variance.root).square().sum(-1)
        return mean, (variance + self.log_variances.unexplained(features)).mT

    def at(self, x: Float[Tensor, "n e"]) -> FactorMoments:
        """Moments of the entries of the factor at x."""
        mean, variance = self.log_variance_at(x)
        n_outputs = mean.shape[1]
        rows, variances = [pad(0.0 * mean[:, :1], (0, n_outputs - 1))], [pad(0.0 * mean[:, :1], (0, n_outputs - 1))]
        features = self.rows(x)
        unexplained = self.rows.unexplained(features)
        # Coefficients of one output share their features, and each has a block of the weights.
        for i, (weights, own) in enumerate(zip(self.coefficients, features, strict=True), start=1):
            blocks = weights.root.reshape(i, own.shape[1], -1)
            known = (own @ blocks).square().sum(-1).mT
            rows.append(pad(own @ weights.mean.reshape(i, -1).mT, (0, n_outputs - i)))
            variances.append(pad(known + unexplained[i - 1, :, None], (0, n_outputs - i)))
        return FactorMoments(mean, variance, torch.stack(rows, dim=1), torch.stack(variances, dim=1))

    def draw(self, x: Float[Tensor, "n e"], normal: Sequence[Float[Tensor, "*s _"]]) -> Float[Tensor, "*s n d d"]:
        """Factors at x of functions drawn from the posterior, made of standard normal numbers.

        Those of each output's log variance first, and then those of each output's coefficients.
        """
        n_outputs = len(self.log_variance.mean)
        diagonal = []
        for i, features in enumerate(self.log_variances(x)):
            weights = self.log_variance.mean[i] + normal[i] @ self.log_variance.root[i].mT
            diagonal.append(torch.exp(0.5 * (weights @ features.mT)))
        factor = torch.diag_embed(torch.stack(diagonal, dim=-1))
        rows = zip(self.coefficients, self.rows(x), normal[n_outputs:], strict=True)
        for i, (posterior, features, numbers) in enumerate(rows, start=1):
            weights = posterior.mean + numbers @ posterior.root.mT
            factor[..., i, :i] = features @ weights.unflatten(-1, (i, -1)).mT
        return factor


class CovarianceSearch:
    """Searches of the hyperparameters of the log variances, and of the coefficients of outputs 1, 2, ..., if any."""

    def __init__(self, families: Families, n_outputs: int, options: SearchOptions) -> None:
        self.log_variance = Search(families.log_variance, n_outputs, options)
        self.coefficient_family = families.coefficients
        self.coefficients = [Search(self.coefficient_family, 1, options) for _ in range(1, n_outputs)]


class _Row(NamedTuple):
    """Regression of an output on those before it, with its coefficients integrated out."""

    regression: Regression
    expected: Float[Tensor, " n"]
    """Expected squares of the residuals."""
    divergence: Tensor | float
    """Of the coefficients' posterior from their prior, in nats."""


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
    location, rows = None, []
    if previous is not None:
        location = previous.log_variance_at(inputs)[0].mT
        rows = _regress(scatter, location, noise, partial(_known_row, previous.coefficients, previous.rows(inputs)))
    for sweep in range(_SWEEPS if scatter.shape[1] > 1 and not cautious else 1):
        squares = _squares(scatter, degrees, noise, rows)
        log_variance = search_log_variance(search.log_variance, fixed, squares, location)
        location = log_variance.location
        # E[exp(-l)] of a normal l: its mean and half its variance.
        precision = torch.exp(-location + 0.5 * log_variance.variance)
        fit_row = partial(_searched_row, search.coefficients, fixed, precision, anew=sweep < _SEARCHES)
        rows = _regress(scatter, location, noise, fit_row)
        evidence = float(log_variance.evidence.sum()) - float(sum(row.divergence for row in rows))
    # The weights of all features, where the searches took only those that carry something.
    searches = search.log_variance, *search.coefficients
    log_theta, *thetas = (each.theta for each in searches if each.theta is not None)
    theta = torch.cat([log_theta[:0], *thetas])
    log_variances, processes = search.log_variance.family.prepared(log_theta), search.coefficient_family.prepared(theta)
    log_weights = fit_log_variance(squares, log_variances(inputs), location).weights
    coefficients = []
    for row, features, its_precision in zip(rows, processes(inputs), precision[1:], strict=True):
        weights = row.regression.fit(features[None], its_precision).weights
        coefficients.append(Weights(weights.mean[0], weights.root[0]))
    return LatentCovariance(log_theta, log_variances, log_weights, theta, processes, coefficients), evidence


def _regress(scatter: Tensor, location: Tensor, noise: NoiseCorrelation | None, fit_row: _FitRow) -> list[_Row]:
    """Regressions of one output after another on those before it, of log variances (d, n) that are known."""
    deviation = torch.exp(0.5 * location)
    tril, rows = deviation[0][:, None, None], []
    for i in range(1, len(location)):
        whitener = None if noise is None else noise.whitener[i]
        regression = Regression.standardize(scatter[:, : i + 1, : i + 1], tril, whitener)
        features, mean, covariance, divergence = fit_row(i, regression)
        rows.append(_Row(regression, regression.expected_squares(features, mean, covariance), divergence))
        # The factor of outputs 0, ..., i, on which the next one is regressed.
        row = torch.cat([features @ mean.reshape(i, -1).mT, deviation[i][:, None]], dim=1)
        tril = torch.cat([pad(tril, (0, 1)), row.unsqueeze(1)], dim=1)
    return rows


def _known_row(
    coefficients: Sequence[Weights], features: Tensor, i: int, _: Regression
) -> tuple[Tensor, Tensor, Tensor, float]:
    mean, root = coefficients[i - 1]
    return features[i - 1], mean, root @ root.mT, 0.0


def _searched_row(
    searches: list[Search], fixed: FixedFeatures, precision: Tensor, i: int, regression: Regression, *, anew: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coefficients of output i given the expected precisions (d, n), their hyperparameters searched anew or kept."""
    search, own = searches[i - 1], precision[i]
    information = (own * regression.before.diagonal(dim1=1, dim2=2).sum(-1)).sum()

    def evidence(theta: Tensor, _: Tensor) -> tuple[Tensor, Gradient]:
        design, vjp = search.family.design_vjp(fixed, theta, information.expand(len(theta)))
        linear = regression.fit(design, own)
        return linear.value, lambda: vjp(regression.gradient(linear, design, own))

    theta = search.run(evidence, regression.response.numel()) if anew or search.theta is None else search.theta
    design, _ = search.family.design_vjp(fixed, theta, information.expand(1))
    linear = regression.fit(design, own)
    return design[0], linear.mean[0], linear.covariance[0], linear.divergence_from_prior()


def _squares(scatter: Tensor, degrees: Tensor, noise: NoiseCorrelation | None, rows: list[_Row]) -> Squares:
    """Squared residuals of each output from its regression on those before it.

    Where samples are correlated and enough at an input, from the regression there by itself: an error of the
    coefficients' processes, as smooth as the demonstrations, would else count as residual.
    """
    totals, kept = list(scatter.diagonal(dim1=1, dim2=2).mT), list(degrees)
    for i, row in enumerate(rows, start=1):
        totals[i] = row.expected
        if noise is not None:
            local = degrees[i] - i * noise.copies[i]
            enough = local >= _ENOUGH_DEGREES * noise.copies[i]
            totals[i] = torch.where(enough, row.regression.local_squares(), row.expected)
            kept[i] = torch.where(enough, local, degrees[i])
    return Squares(torch.stack(totals), torch.stack(kept), noise)
