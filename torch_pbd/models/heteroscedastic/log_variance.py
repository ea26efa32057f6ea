"""Logarithms of conditional variances as Gaussian processes, their latent values integrated out."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.models.heteroscedastic.correlation import NoiseCorrelation
from torch_pbd.models.heteroscedastic.linear import Weights, log_evidence, weights_posterior, weights_root

_MAX_ITER, _TOL = 60, 1e-8
_LARGEST_STEP = 3.0  # in the logarithm of a variance
# Of the pooled variance: an exact zero, as where all recordings start at the origin, has no logarithm.
LEAST_SQUARE = 1e-6


@dataclass(frozen=True)
class Squares:
    """Sums of ``degrees`` squared residuals at n inputs, of b outputs whose pooled variance is one."""

    total: Float[Tensor, "b n"]
    degrees: Float[Tensor, "b n"]
    noise: NoiseCorrelation

    def rows(self, index: Tensor) -> "Squares":
        """Those of some of the outputs."""
        return replace(self, total=self.total[index], degrees=self.degrees[index], noise=self.noise.rows(index))

    def log_mean(self) -> Float[Tensor, "b n"]:
        """Logarithm of the mean square."""
        return (self.total / self.degrees).clamp_min(LEAST_SQUARE).log()


def fit_log_variance(squares: Squares, features: Float[Tensor, "b n p"]) -> tuple[Weights, Float[Tensor, " b"]]:
    """Posterior of the weights of ``log_variance = features @ weights``, and the log evidence, in nats.

    The weights are standard normal numbers a priori; the last feature is a constant. The evidence is
    differentiable in the features.
    """
    if squares.noise.of_squares is None or squares.noise.copies is None:
        return _fit_independent(squares, features)
    return _fit_correlated(squares, features, squares.noise.of_squares, squares.noise.copies)


def _fit_independent(squares: Squares, features: Tensor) -> tuple[Weights, Tensor]:
    """Variational approximation by a normal distribution; the evidence is its lower bound.

    Its covariance is the inverse of the Fisher information, which for a log variance does not depend on its
    value. Its mean maximizes the bound, in which E[1 / variance] = exp(-mean + variance of the log / 2) is
    exact, and so need not be differentiated through.
    """
    root = weights_root((0.5 * squares.degrees).sqrt().unsqueeze(-1) * features)
    target = squares.log_mean() + 0.5 * (features @ root).square().sum(-1)
    with torch.no_grad():
        mean = _maximize(features, target, squares.degrees, _constant(squares, features))
    deviance = _deviance((features @ mean.unsqueeze(-1)).squeeze(-1) - target, squares.degrees)[0].square().sum(-1)
    # The traces of the Fisher information and of the divergence from the prior add up to a constant.
    log_det = root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
    saturated = (squares.degrees * (squares.log_mean() + 1.0 + math.log(2.0 * math.pi))).sum(-1)
    return Weights(mean, root), log_det - 0.5 * (deviance + mean.square().sum(-1) + saturated)


def _fit_correlated(squares: Squares, features: Tensor, whitener: Tensor, copies: Tensor) -> tuple[Weights, Tensor]:
    """Closed form: the log of a mean square is the log variance plus the log of a chi-squared number.

    That has a known mean and variance, and along a demonstration the correlation that the whitener takes
    out; it is treated as normal, which the smooth noise of demonstrations needs more than its exact shape.
    """
    half = 0.5 * squares.degrees / copies
    response = squares.log_mean() - torch.digamma(half) + half.log()
    weight = (copies / torch.polygamma(1, half)).sqrt().unsqueeze(-1)  # the whitener takes the copies out again
    design = whitener @ (weight * features)
    response = (whitener @ (weight * response.unsqueeze(-1))).squeeze(-1)
    constant = weight.squeeze(-1).log().sum(-1) - 0.5 * response.square().sum(-1)
    return weights_posterior(design, response), log_evidence(design, response) + constant


def _constant(squares: Squares, features: Tensor) -> Tensor:
    """Weights of the pooled variance everywhere."""
    weights = torch.zeros_like(features[:, 0, :])
    pooled = (squares.total.sum(-1) / squares.degrees.sum(-1)).clamp_min(LEAST_SQUARE).log()
    weights[:, -1] = pooled / features[:, 0, -1]
    return weights


def _maximize(features: Tensor, target: Tensor, degrees: Tensor, mean: Tensor) -> Tensor:
    """Gauss-Newton steps, each halved until the bound does not fall."""
    value, residual, jacobian = _objective(features, target, degrees, mean)
    eye = torch.eye(mean.shape[-1]).to(mean)
    for _ in range(_MAX_ITER):
        gradient = jacobian.mT @ residual.unsqueeze(-1) + mean.unsqueeze(-1)
        step = -torch.linalg.solve(jacobian.mT @ jacobian + eye, gradient).squeeze(-1)
        change = (features @ step.unsqueeze(-1)).abs().amax((-2, -1))
        share = (_LARGEST_STEP / change.clamp_min(1e-300)).clamp_max(1.0)
        for _ in range(20):
            trial = mean + share[:, None] * step
            tried = _objective(features, target, degrees, trial)
            worse = ~(tried[0] <= value + 1e-12 * value.abs())
            if not bool(worse.any()):
                break
            share = torch.where(worse, 0.5 * share, share)
        better = ~worse
        mean = torch.where(better[:, None], trial, mean)
        value = torch.where(better, tried[0], value)
        residual = torch.where(better[:, None], tried[1], residual)
        jacobian = torch.where(better[:, None, None], tried[2], jacobian)
        if float((share * change).where(better, 0.0).max()) < _TOL:
            break
    return mean


def _objective(features: Tensor, target: Tensor, degrees: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Half the sum of squares to be minimized, the residuals (b, n) and their Jacobian (b, n, p)."""
    residual, slope = _deviance((features @ mean.unsqueeze(-1)).squeeze(-1) - target, degrees)
    value = 0.5 * residual.square().sum(-1) + 0.5 * mean.square().sum(-1)
    return value, residual, slope.unsqueeze(-1) * features


def _deviance(x: Tensor, degrees: Tensor) -> tuple[Tensor, Tensor]:
    """Signed root of ``degrees * (x + exp(-x) - 1)``, and its derivative.

    x is the log variance less that which fits best; the square is minus twice the log likelihood of normal
    residuals, less its maximum.
    """
    x = x.clamp_min(-40.0)
    near = x.abs() < 1e-3
    away = x.where(~near, 1.0)
    root = (away + torch.expm1(-away)).sqrt() * away.sign()
    value = torch.where(near, x * (1.0 - x / 6.0 + x.square() / 36.0) / 2.0**0.5, root)
    slope = torch.where(near, (1.0 - x / 3.0 + x.square() / 12.0) / 2.0**0.5, -torch.expm1(-away) / (2.0 * root))
    scale = degrees.sqrt()
    return scale * value, scale * slope
