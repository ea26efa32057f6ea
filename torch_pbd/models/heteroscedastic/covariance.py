"""Fit of the covariance's latent processes to the scatter of the residuals."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.inducing import FixedFeatures
from torch_pbd.models.heteroscedastic.correlation import NoiseCorrelation
from torch_pbd.models.heteroscedastic.latent import LatentCovariance
from torch_pbd.models.heteroscedastic.linear import LinearEvidence, Weights
from torch_pbd.models.heteroscedastic.log_variance import LEAST_SQUARE, LogVariance, Squares, fit_log_variance
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.regression import Regression
from torch_pbd.models.heteroscedastic.search import Gradient, Search, SearchOptions

_SWEEPS = 3
_SEARCHES = 2  # sweeps that look for the coefficients' hyperparameters too
# An input with at least so many degrees of freedom left tells a conditional variance by itself.
_ENOUGH_DEGREES = 2.0


@dataclass(frozen=True)
class CovarianceSearches:
    """Searches of the hyperparameters of the log variances, and of the coefficients of outputs 1, 2, ..."""

    log_variance: Search
    coefficients: list[Search]
    coefficient_family: ProcessFamily

    @classmethod
    def of(
        cls, families: tuple[ProcessFamily, ProcessFamily], n_outputs: int, n_features: int, options: SearchOptions
    ) -> "CovarianceSearches":
        """Searches that have not begun."""
        return cls(
            Search(families[0], n_outputs, n_features, options),
            [Search(families[1], 1, n_features, options) for _ in range(1, n_outputs)],
            families[1],
        )


@dataclass
class _Sweep:
    """What a sweep leaves to the next."""

    location: Tensor | None = None
    """Log variances (d, n)."""
    precision: Tensor | None = None
    """Expected inverses of the conditional variances (d, n)."""
    regressions: list[Regression] = field(default_factory=list)
    expected: list[Tensor] = field(default_factory=list)
    """Squared residuals (n,) of outputs 1, 2, ... from their regressions."""
    evidence: float = 0.0


def fit_covariance(
    searches: CovarianceSearches,
    inputs: Float[Tensor, "n e"],
    scatter: Float[Tensor, "n d d"],
    degrees: Float[Tensor, "d n"],
    noise: NoiseCorrelation,
    previous: LatentCovariance | None,
) -> tuple[LatentCovariance, float]:
    """Posterior of the factor, and the log evidence in nats.

    The log variances given the expected squares of the residuals, and the coefficients given the expected
    precisions, by turns: each raises the same lower bound of the evidence where rows are independent.

    Parameters
    ----------
    searches : CovarianceSearches
        Of processes on the same features.
    scatter : Tensor of shape (n, d, d)
        Sum of the outer products of the residuals at each input, whose pooled covariance is the unit matrix.
    degrees : Tensor of shape (d, n)
        Their degrees of freedom; of each output given those before it.
    noise : NoiseCorrelation
        Of scatters at different inputs.
    previous : LatentCovariance or None
        Where to start.
    """
    # An output that is constant is noise of the least variance too where later ones are regressed on it: to zeros
    # any coefficient would fit, and its uncertainty would count as their variance.
    scatter = scatter + LEAST_SQUARE * torch.diag_embed(degrees.mT)
    fixed = FixedFeatures(searches.log_variance.family.features, inputs)
    last = _Sweep() if previous is None else _from_previous(previous, inputs, scatter, noise)
    for sweep in range(_SWEEPS if scatter.shape[1] > 1 else 1):
        squares = _squares(scatter, degrees, noise, last)
        log_variance = _fit_log_variance(searches.log_variance, fixed, squares, last.location)
        precision = torch.exp(-log_variance.location + 0.5 * log_variance.variance)
        last = _Sweep(log_variance.location, precision, evidence=float(log_variance.evidence.sum()))
        _fit_coefficients(searches.coefficients, fixed, scatter, noise, last, anew=sweep < _SEARCHES)
    return _posterior(searches, inputs, squares, last), last.evidence


def _from_previous(previous: LatentCovariance, inputs: Tensor, scatter: Tensor, noise: NoiseCorrelation) -> _Sweep:
    moments = previous.at(inputs)
    tril = moments.tril()
    regressions, expected = [], []
    for i, weights in enumerate(previous.coefficients, start=1):
        known = Regression.of(scatter[:, : i + 1, : i + 1], tril[:, :i, :i], _of_output(noise.of_squares, i))
        features = previous.coefficient_family.design(inputs, previous.coefficient_theta[i - 1 : i])[0]
        regressions.append(known)
        expected.append(_sum(known.squares(features, weights.mean, weights.root @ weights.root.mT)))
    return _Sweep(moments.log_variance.mT, None, regressions, expected)


def _fit_log_variance(search: Search, fixed: FixedFeatures, squares: Squares, near: Tensor | None) -> LogVariance:
    """Posterior of the log variances, which are ``near`` those given."""
    information = 0.5 * squares.degrees.sum(-1)
    near = (squares.log_pooled.expand_as(squares.total) if near is None else near).clone()

    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        design, vjp = search.family.design_vjp(fixed, theta, information[rows])
        found = fit_log_variance(squares.rows(rows), design, near[rows])
        if len(rows) <= len(near):
            near[rows] = found.location  # where the next evaluation starts
        return found.evidence, lambda: vjp(found.gradient())

    theta = search.run(evidence, squares.total)
    return fit_log_variance(squares, search.family.design_vjp(fixed, theta, information)[0], near)


def _fit_coefficients(
    searches: list[Search], fixed: FixedFeatures, scatter: Tensor, noise: NoiseCorrelation, state: _Sweep, *, anew: bool
) -> None:
    """One output after another, as each is regressed on those before it; ``anew`` searches their hyperparameters."""
    assert state.location is not None
    assert state.precision is not None
    deviation = torch.exp(0.5 * state.location)
    tril = deviation[0][:, None, None]
    for i, search in enumerate(searches, start=1):
        known = Regression.of(scatter[:, : i + 1, : i + 1], tril, _of_output(noise.of_squares, i))
        precision = state.precision[i]
        design, linear = _fit_row(search, fixed, known, precision, anew=anew or search.theta is None)
        features = design[0]
        state.evidence -= float(linear.divergence_from_prior())
        state.regressions.append(known)
        state.expected.append(_sum(known.squares(features, linear.mean[0], linear.covariance[0])))
        tril = _with_row(tril, features @ linear.mean.reshape(i, -1).mT, deviation[i])


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
        search.run(evidence, precision)
    assert search.theta is not None
    if not latest or not torch.equal(latest[0][0], search.theta):
        evidence(search.theta, torch.arange(1))
    return latest[0][1:]


def _squares(scatter: Tensor, degrees: Tensor, noise: NoiseCorrelation, last: _Sweep) -> Squares:
    """Squared residuals of each output from its regression on those before it.

    Where samples of a demonstration are correlated and there are enough of them at an input, from the
    regression at that input by itself: an error of the processes of its coefficients, as smooth as the
    demonstrations, would else count as residual.
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
    """Of the weights of all features."""
    theta = searches.log_variance.theta
    assert theta is not None
    assert last.precision is not None
    family = searches.log_variance.family
    log_variance = fit_log_variance(squares, family.design(inputs, theta), last.location).weights
    coefficients, coefficient_theta = [], theta[:0]
    if last.regressions:
        coefficient_theta = torch.cat([search.theta for search in searches.coefficients if search.theta is not None])
        features = searches.coefficient_family.design(inputs, coefficient_theta)
        for known, own, precision in zip(last.regressions, features, last.precision[1:], strict=True):
            weights = known.fit(own[None], precision).weights()
            coefficients.append(Weights(weights.mean[0], weights.root[0]))
    return LatentCovariance(family, searches.coefficient_family, theta, log_variance, coefficient_theta, coefficients)


def _sum(parts: tuple[Tensor, Tensor]) -> Tensor:
    return parts[0] + parts[1]


def _with_row(tril: Tensor, row: Tensor, diagonal: Tensor) -> Tensor:
    above = torch.nn.functional.pad(tril, (0, 1))
    below = torch.cat([row, diagonal[:, None]], dim=1)
    return torch.cat([above, below.unsqueeze(1)], dim=1)


def _of_output(whiteners: Tensor | None, output: int) -> Tensor | None:
    return None if whiteners is None else whiteners[output]
