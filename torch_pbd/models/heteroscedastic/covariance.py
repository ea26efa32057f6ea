"""Fit of the covariance's latent processes to the scatter of the residuals."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.models.heteroscedastic.correlation import NoiseCorrelation
from torch_pbd.models.heteroscedastic.latent import LatentCovariance
from torch_pbd.models.heteroscedastic.linear import Weights, divergence_from_prior
from torch_pbd.models.heteroscedastic.log_variance import LEAST_SQUARE, Squares, fit_log_variance
from torch_pbd.models.heteroscedastic.processes import ProcessFamily, SearchOptions, search
from torch_pbd.models.heteroscedastic.regression import Regression

_SWEEPS = 3
_SEARCHES = 2  # sweeps that look for the coefficients' hyperparameters too
# An input with at least so many degrees of freedom left tells a conditional variance by itself.
_ENOUGH_DEGREES = 2.0


def fit_covariance(
    families: tuple[ProcessFamily, ProcessFamily],
    inputs: Float[Tensor, "n e"],
    scatter: Float[Tensor, "n d d"],
    degrees: Float[Tensor, "d n"],
    noise: NoiseCorrelation,
    previous: LatentCovariance | None,
    options: SearchOptions,
) -> tuple[LatentCovariance, float]:
    """Posterior of the factor, and the log evidence in nats.

    The log variances given the expected squares of the residuals, and the coefficients given the expected
    precisions, by turns: each raises the same lower bound of the evidence where rows are independent.

    Parameters
    ----------
    families : (ProcessFamily, ProcessFamily)
        Of the log variances and of the coefficients.
    scatter : Tensor of shape (n, d, d)
        Sum of the outer products of the residuals at each input, whose pooled covariance is the unit matrix.
    degrees : Tensor of shape (d, n)
        Their degrees of freedom; of each output given those before it.
    noise : NoiseCorrelation
        Of scatters at different inputs.
    previous : LatentCovariance or None
        Where to start.
    """
    variance_family, coefficient_family = families
    n_outputs, n_features = scatter.shape[1], inputs.shape[1]
    # An output that is constant is noise of the least variance too where later ones are regressed on it: to zeros
    # any coefficient would fit, and its uncertainty would count as their variance.
    scatter = scatter + LEAST_SQUARE * torch.diag_embed(degrees.mT)
    fit = previous
    regressions = [] if fit is None else _regressions(scatter, fit.at(inputs).tril(), noise)
    for sweep in range(_SWEEPS if n_outputs > 1 else 1):
        squares = _squares(scatter, degrees, noise, regressions, fit, inputs)

        def variance_evidence(theta: Tensor, rows: Int64[Tensor, " a"], squares: Squares = squares) -> Tensor:
            return fit_log_variance(squares.rows(rows), variance_family.design(inputs, theta))[1]

        start = None if fit is None else fit.log_variance_theta
        theta = search(variance_family, variance_evidence, start, (n_outputs, n_features), scatter, options)
        features = variance_family.design(inputs, theta)
        log_variance, evidence = fit_log_variance(squares, features)
        mean = (features @ log_variance.mean.unsqueeze(-1)).squeeze(-1)
        precision = torch.exp(-mean + 0.5 * (features @ log_variance.root).square().sum(-1))
        tril = torch.exp(0.5 * mean[0])[:, None, None]
        regressions, thetas, coefficients, total = [], [], [], float(evidence.sum())
        for i in range(1, n_outputs):
            known = Regression.of(scatter[:, : i + 1, : i + 1], tril, _of_output(noise.of_squares, i))
            own = None if fit is None else fit.coefficient_theta[i - 1 : i]
            if own is None or sweep < _SEARCHES:
                own = _search_coefficients(coefficient_family, known, precision[i], inputs, own, options)
            row_features = coefficient_family.design(inputs, own)
            coefficients.append(known.fit(row_features[0], precision[i]))
            total -= divergence_from_prior(coefficients[-1])
            thetas.append(own)
            regressions.append(known)
            row = row_features[0] @ coefficients[-1].mean.reshape(i, -1).mT
            tril = _with_row(tril, row, torch.exp(0.5 * mean[i]))
        coefficient_theta = torch.cat(thetas) if thetas else theta[:0]
        fit = LatentCovariance(
            variance_family, coefficient_family, theta, Weights(*log_variance), coefficient_theta, coefficients
        )
    assert fit is not None
    return fit, total


def _search_coefficients(
    family: ProcessFamily,
    known: Regression,
    precision: Tensor,
    inputs: Tensor,
    start: Tensor | None,
    options: SearchOptions,
) -> Tensor:
    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> Tensor:
        return known.evidence(family.design(inputs, theta), precision)

    return search(family, evidence, start, (1, inputs.shape[1]), inputs, options)


def _squares(
    scatter: Tensor,
    degrees: Tensor,
    noise: NoiseCorrelation,
    regressions: list[Regression],
    fit: LatentCovariance | None,
    inputs: Tensor,
) -> Squares:
    """Squared residuals of each output from its regression on those before it.

    Where samples of a demonstration are correlated and there are enough of them at an input, from the
    regression at that input by itself: an error of the processes of its coefficients, as smooth as the
    demonstrations, would else count as residual.
    """
    totals, kept = [scatter[:, 0, 0]], [degrees[0]]
    for i in range(1, scatter.shape[1]):
        total, left = scatter[:, i, i], degrees[i]
        if regressions and fit is not None:
            known = regressions[i - 1]
            features = fit.coefficient_family.design(inputs, fit.coefficient_theta[i - 1 : i])[0]
            total = sum(known.squares(features, fit.coefficients[i - 1]), torch.zeros_like(total))
            if noise.copies is not None:
                local = degrees[i] - i * noise.copies[i]
                enough = local >= _ENOUGH_DEGREES * noise.copies[i]
                total, left = torch.where(enough, known.local_squares(), total), torch.where(enough, local, left)
        totals.append(total)
        kept.append(left)
    return Squares(torch.stack(totals), torch.stack(kept), noise)


def _regressions(scatter: Tensor, tril: Tensor, noise: NoiseCorrelation) -> list[Regression]:
    return [
        Regression.of(scatter[:, : i + 1, : i + 1], tril[:, :i, :i], _of_output(noise.of_squares, i))
        for i in range(1, scatter.shape[1])
    ]


def _with_row(tril: Tensor, row: Tensor, diagonal: Tensor) -> Tensor:
    above = torch.nn.functional.pad(tril, (0, 1))
    below = torch.cat([row, diagonal[:, None]], dim=1)
    return torch.cat([above, below.unsqueeze(1)], dim=1)


def _of_output(whiteners: Tensor | None, output: int) -> Tensor | None:
    return None if whiteners is None else whiteners[output]
