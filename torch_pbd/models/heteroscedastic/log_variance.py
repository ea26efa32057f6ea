"""Logarithms of conditional variances as Gaussian processes, their latent values integrated out."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import log_det, safe_cholesky
from torch_pbd.models.heteroscedastic.processes import Evidence, FixedFeatures, Gradient
from torch_pbd.models.heteroscedastic.regression import (
    LinearEvidence,
    NoiseCorrelation,
    weights_factor,
    whiten,
    whiten_vjp,
)
from torch_pbd.models.training import TrainingSet

LEAST_SQUARE = 1e-6
"""Least mean square, of the pooled variance: an exact zero, as where all recordings start at the origin, has no
logarithm."""

# Newton's steps (in the logarithm of a variance) end at this one: that after it is about its square.
_MAX_ITER, _TOL = 60, 1e-5
_HALVINGS, _ROUNDING = 20, 1e-12  # of a step that does not descend, and what counts as none of a loss
_LEAST_RESIDUAL = -40.0  # bounds exp(-x) where a start is far below its target


@dataclass(frozen=True)
class Squares:
    """Sums of ``degrees`` squared residuals at n inputs, of b outputs whose pooled variance is one."""

    total: Float[Tensor, "b n"]
    degrees: Float[Tensor, "b n"]
    noise: NoiseCorrelation | None
    """Correlation of the mean squares; None where they are independent."""

    def restrict(self, outputs: Int64[Tensor, " a"]) -> "Squares":
        """Squares of the selected outputs."""
        if len(outputs) == len(self.total) and torch.equal(outputs, torch.arange(len(outputs), device=outputs.device)):
            return self  # with its cached properties
        noise = self.noise and NoiseCorrelation(*(part[outputs] for part in self.noise))
        return Squares(self.total[outputs], self.degrees[outputs], noise)

    @cached_property
    def information(self) -> Float[Tensor, " b"]:
        """Sum of the precisions with which log variances are observed."""
        return 0.5 * self.degrees.sum(-1)

    @cached_property
    def log_mean(self) -> Float[Tensor, "b n"]:
        """Logarithm of the mean square."""
        return (self.total / self.degrees).clamp_min(LEAST_SQUARE).log()

    @cached_property
    def log_pooled(self) -> Float[Tensor, "b n"]:
        """Logarithm of the pooled variance of each output, the same at all inputs."""
        mean = self.total.sum(-1, keepdim=True) / self.degrees.sum(-1, keepdim=True)
        return mean.clamp_min(LEAST_SQUARE).log().expand_as(self.total)


class LogVariance(NamedTuple):
    """Posterior of ``log_variance = features @ weights``, the weights standard normal numbers a priori.

    The last feature is a constant.
    """

    posterior: LinearEvidence
    """Of the weights; its value is the log evidence of the features, in nats."""
    location: Float[Tensor, "b n"]
    """Expected log variances."""
    gradient: Callable[[], Float[Tensor, "b n p"]]
    """Computes the gradient of the evidence in the features."""


def log_variance_evidence(fixed: FixedFeatures, squares: Squares, near: Float[Tensor, "b n"]) -> Evidence:
    """Log evidence of hyperparameters; the log variances are looked for ``near`` those given, which it updates."""

    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        design, vjp = fixed.design_vjp(theta, squares.information[rows])
        found = fit_log_variance(squares.restrict(rows), design, near[rows])
        if len(rows) <= len(near):
            near[rows] = found.location  # where the next evaluation starts
        return found.posterior.value, lambda: vjp(found.gradient())

    return evidence


def fit_log_variance(squares: Squares, features: Float[Tensor, "b n p"], start: Float[Tensor, "b n"]) -> LogVariance:
    """Posterior and log evidence; ``start`` are log variances near the posterior's.

    Of independent squares it is a variational approximation by a normal distribution; the evidence is its lower bound.
    Its precision P is one plus the Fisher information, F' diag(h) F of the features F and half the degrees h, which
    for a log variance does not depend on its value. Its mean m maximizes the bound, in which
    E[1 / variance] = exp(-mean + variance of the log / 2) is exact. With the target t, the log mean square plus half
    the variance of the log, and x = F m - t the bound is -log|P| / 2 - sum of h (x + exp(-x)) - m'm / 2 and a
    constant: the traces of the Fisher information and of the divergence from the prior add up to one.

    Gradient in F, where r = h (1 - exp(-x)) is that of the sum in x and A = F inv(P): -diag(h) A from log|P|; -r m'
    from F m, the mean itself being at its maximum; and from t, half the diagonal of F inv(P) F',
    diag(r) A - diag(h) F Q with Q = A' diag(r) A.
    """
    if squares.noise is not None:
        return _fit_correlated(squares, squares.noise, features)
    half = 0.5 * squares.degrees
    # P = 1 + F' diag(h) F, and the variances of the logarithms, the diagonal of F inv(P) F'.
    factor, _ = weights_factor(half.sqrt().unsqueeze(-1) * features, torch.zeros_like(half))
    spread = features @ torch.cholesky_inverse(factor, upper=True)
    variance = (spread * features).sum(-1)
    log_mean = squares.log_mean
    target = log_mean + 0.5 * variance
    mean, location = _maximize(features, target, half, squares.log_pooled, start)
    residual = location - target
    decay = torch.exp(-residual)
    deviance = 2.0 * (half * (residual + decay - 1.0)).sum(-1)
    # The constant: the likelihood of log variances that are the log mean squares, each by itself.
    saturated = (squares.degrees * (log_mean + 1.0 + math.log(2.0 * math.pi))).sum(-1)
    evidence = -0.5 * (deviance + mean.square().sum(-1) + saturated) - log_det(factor)

    def gradient() -> Tensor:
        slope = (half * (1.0 - decay)).unsqueeze(-1)
        through_variance = features @ (spread.mT @ (slope * spread))  # F Q
        in_log_det = (slope - half.unsqueeze(-1)) * spread
        return in_log_det - half.unsqueeze(-1) * through_variance - slope * mean.unsqueeze(-2)

    return LogVariance(LinearEvidence(evidence, mean, factor), location, gradient)


def _fit_correlated(squares: Squares, noise: NoiseCorrelation, features: Tensor) -> LogVariance:
    """Closed form: the log of a mean square is the log variance plus the log of a chi-squared number.

    Over its degrees k that has the mean digamma(k / 2) - log(k / 2), below zero, and the variance trigamma(k / 2), and
    along a demonstration the correlation that the whitener takes out. It is treated as normal, which the smooth noise
    of demonstrations needs more than its exact shape.
    """
    half = 0.5 * squares.degrees / noise.copies
    unbiased = squares.log_mean - torch.digamma(half) + half.log()
    weight = (noise.copies / torch.polygamma(1, half)).sqrt()  # the whitener takes the copies out again
    design = whiten(noise.whitener, weight.unsqueeze(-1) * features)
    response = whiten(noise.whitener, (weight * unbiased).unsqueeze(-1)).squeeze(-1)
    linear = LinearEvidence.fit(design, response)
    location = (features @ linear.mean.unsqueeze(-1)).squeeze(-1)

    def gradient() -> Tensor:
        return weight.unsqueeze(-1) * whiten_vjp(noise.whitener, linear.gradient(design, response))

    return LogVariance(replace(linear, value=linear.value + weight.log().sum(-1)), location, gradient)


def _maximize(features: Tensor, target: Tensor, half: Tensor, pooled: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of the weights that minimizes sum of h (x + exp(-x)) + m'm / 2, x = F m - t, and F m.

    By iterated least squares: with the curvature w of the sum the next mean solves
    (1 + F' diag(w) F) m = F' (w F m - slope). The first takes F m from the ``start``; if that was no better
    than the ``pooled`` variance everywhere, it starts there again.
    """
    mean, location = _least_squares(features, target, half, start)
    value = _loss(location - target, half, mean)
    constant = torch.zeros_like(mean)
    constant[:, -1] = pooled[:, 0] / features[:, 0, -1]
    lost = ~(value <= _loss(pooled - target, half, constant))
    if bool(lost.any()):
        mean = torch.where(lost[:, None], constant, mean)
        location = torch.where(lost[:, None], pooled, location)
        value = _loss(location - target, half, mean)
    for _ in range(_MAX_ITER):
        new_mean, new_location = _least_squares(features, target, half, location)
        step, change = new_mean - mean, new_location - location
        # Newton's step, or as much of it as descends.
        share = torch.ones_like(value)
        for _ in range(_HALVINGS):
            new_value = _loss(new_location - target, half, new_mean)
            worse = ~(new_value <= value + _ROUNDING * value.abs())
            if not bool(worse.any()):
                break
            share = torch.where(worse, 0.5 * share, share)
            new_mean, new_location = mean + share[:, None] * step, location + share[:, None] * change
        better = ~worse
        mean = torch.where(better[:, None], new_mean, mean)
        location = torch.where(better[:, None], new_location, location)
        value = torch.where(better, new_value, value)
        if float((share * change.abs().amax(-1)).where(better, 0.0).max()) < _TOL:
            break
    return mean, location


def _least_squares(features: Tensor, target: Tensor, half: Tensor, location: Tensor) -> tuple[Tensor, Tensor]:
    """Next mean and log variances, by Newton's method."""
    decay = torch.exp(-(location - target).clamp_min(_LEAST_RESIDUAL))
    slope, weight = half * (1.0 - decay), half * decay
    precision = features.mT @ (weight.unsqueeze(-1) * features) + torch.eye(features.shape[-1]).to(features)
    factor = safe_cholesky(precision, name="the precision of the log variances")
    projected = features.mT @ (weight * location - slope).unsqueeze(-1)
    mean = torch.cholesky_solve(projected, factor)
    return mean.squeeze(-1), (features @ mean).squeeze(-1)


def _loss(residual: Tensor, half: Tensor, mean: Tensor) -> Tensor:
    """Sum of h (x + exp(-x)) + m'm / 2."""
    return (half * (residual + torch.exp(-residual.clamp_min(_LEAST_RESIDUAL)))).sum(-1) + 0.5 * mean.square().sum(-1)


def squares_within(training: TrainingSet, normal: Tensor, noise: NoiseCorrelation | None) -> Squares:
    """Squares of each output around its mean at each input, which an error of the mean does not change; around zero at
    inputs of one row.
    """
    counts = training.counts
    means = torch.where(counts[:, None] > 1.0, training.sums(normal) / counts[:, None], 0.0)
    squares = training.sums((normal - means[training.index]).square())
    degrees = torch.where(counts > 1.0, counts - 1.0, counts).expand(normal.shape[1], -1)
    return Squares(squares.mT, degrees, noise)
