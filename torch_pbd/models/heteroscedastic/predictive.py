"""What few demonstrations leave open, where samples of each are correlated.

Student's t is the law of a new deviation where the covariance Sigma is known from n independent ones: at an input n is
told by the posterior of the log variances, which knows of K demonstrations at independent places.

- A variance known from n squares has an inverse gamma posterior; its logarithm has variance trigamma(n / 2), and its
  expectation is n / (n - 2) times the scale of the t.
- The error of the mean, Sigma / K where the data decide, is of the same unknown Sigma: it is in the tails too, and what
  is expected of it is the error under noise n / (n - 2) times that which fits best.
- The correlations R have the logarithm G = log R, which is for two outputs Fisher's z of their correlation. Entries of
  an estimate of G err by 1 / n whatever R is (Archakov and Hansen, "A new parametrization of correlation matrices",
  Econometrica 89, 2021). With the prior N(0, tau^2) of the entries, G is expected to be ``tau^2 / (tau^2 + 1 / n)``
  times its estimate. The recordings themselves tell tau^2.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import spectral_map
from torch_pbd.models.heteroscedastic.covariance import degrees_of_freedom

# Variance of Fisher's z of a correlation that is uniform from -1 to 1.
_UNIFORM = math.pi**2 / 12.0
_LEAST_EIGENVALUE = 1e-12  # of correlations: rounding, where outputs are copies of each other


def as_inverse_gamma(variance: Tensor) -> Tensor:
    """Variances of normal logarithms whose exponentials have the mean that an inverse gamma's has.

    The logarithm of an inverse gamma number of n degrees of freedom and mean m is expected at
    ``log m + log(n / 2 - 1) - digamma(n / 2)``, that of a normal one at ``log m`` less half its variance.
    """
    half = 0.5 * degrees_of_freedom(variance)
    return 2.0 * (torch.digamma(half) - (half - 1.0).log())


def under_expected_noise(
    error_root: Float[Tensor, "n d d"], degrees: Float[Tensor, " n"], prior_variance: Float[Tensor, " d"]
) -> Float[Tensor, "n d d"]:
    """Root of the covariance of the mean's error, were the noise s = n / (n - 2) times as large.

    With the covariance E of the error and A of the mean's prior, the data's part of the precision is inv(E) - inv(A):
    it becomes ``inv(inv(E) / s + (1 - 1 / s) inv(A)) = s L inv(I + (s - 1) L' inv(A) L) L'`` of the root L of E.
    """
    scale = (degrees / (degrees - 2.0))[:, None, None]
    beside_prior = error_root / prior_variance.sqrt()[:, None]
    inner = torch.eye(len(prior_variance)).to(error_root) + (scale - 1.0) * (beside_prior.mT @ beside_prior)
    solved = torch.linalg.solve_triangular(torch.linalg.cholesky(inner), error_root.mT, upper=False)
    return scale.sqrt() * solved.mT


def log_correlation_variance(
    root: Float[Tensor, "n d r"], degrees: Float[Tensor, " n"], n_places: float
) -> Float[Tensor, ""]:
    """Variance tau^2 of the logarithms of correlations, by moments: their mean square less that of their errors.

    Of as many numbers as there are pairs of outputs and ``n_places`` independent places along a demonstration, and of
    one more, as of two outputs whose correlation may be anything.
    """
    logarithm, _ = _log_correlation(root)
    i, j = torch.tril_indices(*logarithm.shape[1:], offset=-1, device=root.device)
    number = n_places * len(i)
    square = logarithm[:, i, j].square().mean() if len(i) else root.new_zeros(())
    excess = square - (1.0 / degrees).mean()
    return ((number * excess + _UNIFORM) / (number + 1.0)).clamp_min(0.0)


def shrink_correlation(
    root: Float[Tensor, "n d r"],
    degrees: Float[Tensor, " n"],
    variance: Float[Tensor, ""],
    draws: Float[Tensor, "*s n d d"] | None = None,
) -> Float[Tensor, "*s n d d"]:
    """Roots with the correlations expected of a prior of this variance, the deviations as they are.

    Of ``draws`` from the posterior without that prior, around this root, draws from the posterior with it.
    """
    logarithm, deviation = _log_correlation(root)
    total = (variance + 1.0 / degrees)[:, None, None]
    shrunk = variance / total * logarithm
    if draws is not None:
        drawn, deviation = _log_correlation(draws)
        shrunk = shrunk + variance.sqrt() * total.rsqrt() * (drawn - logarithm)
    half = spectral_map(0.5 * shrunk, torch.exp)
    return deviation / half.norm(dim=-1, keepdim=True) * half


def _log_correlation(root: Float[Tensor, "*s n d r"]) -> tuple[Float[Tensor, "*s n d d"], Float[Tensor, "*s n d 1"]]:
    """Logarithms of the correlations, and the deviations."""
    deviation = root.norm(dim=-1, keepdim=True)
    unit = root / deviation
    return spectral_map(unit @ unit.mT, lambda values: values.clamp_min(_LEAST_EIGENVALUE).log()), deviation
