"""Posterior of mean and covariance: what they are at x, and what few demonstrations leave open.

Where samples of a demonstration are correlated Student's t is the law of a new deviation, as where the covariance Sigma
is known from n independent ones: at an input n is told by the posterior of the log variances, which knows of K
demonstrations at independent places.

- A variance known from n squares has an inverse gamma posterior; its logarithm has variance trigamma(n / 2), and its
  expectation is n / (n - 2) times the scale of the t.
- The error of the mean, Sigma / K where the data decide, is of the same unknown Sigma: it is in the tails too, and what
  is expected of it is the error under noise n / (n - 2) times that which fits best.
- The correlations R have the logarithm G = log R, which is for two outputs Fisher's z of their correlation. Entries of
  an estimate of G err by 1 / n whatever R is (Archakov and Hansen, "A new parametrization of correlation matrices",
  Econometrica 89, 2021). With the prior N(0, tau^2) of the entries, G is expected to be ``tau^2 / (tau^2 + 1 / n)``
  times its estimate. The recordings themselves tell tau^2. Of many outputs the fit has shrunk them already.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.observations import spacing
from torch_pbd.linalg import spectral_map
from torch_pbd.models.heteroscedastic.processes import Processes
from torch_pbd.models.heteroscedastic.regression import Weights
from torch_pbd.models.training import TrainingSet

_LEAST_DEGREES = 3.0  # below two, Student's t has no covariance
# Longest length scale by which distance from the data is judged, in ranges of the input times the number of inputs;
# but two spacings of the inducing inputs at least. Of few stations on a line, two of most spacings, as a hole is none,
# and half the range, or the prior would not be back a range away from two of them.
_STATIONS = 10
_REACH = 0.1
# Variance of Fisher's z of a correlation that is uniform from -1 to 1.
_UNIFORM = math.pi**2 / 12.0
_LEAST_EIGENVALUE = 1e-12  # of correlations: rounding, where outputs are copies of each other


@dataclass(frozen=True)
class LatentMean:
    """Posterior of the mean: weights of one output after another."""

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

    def residual(self, training: TrainingSet) -> Float[Tensor, "rows d"]:
        """Residual of y from the expected mean at each row."""
        if training.repeats_inputs:
            return training.residual(self.expected_at)
        processes = self.processes
        weights = processes.amplitude[:, None] * self.weights.mean.reshape(len(processes.theta), -1)
        # Weights of the kernel with the inducing inputs, from those of the features: no equations are solved for
        # each row.
        weights = torch.linalg.solve_triangular(processes.factor.mT, weights.unsqueeze(-1), upper=True)
        return training.residual(lambda x: (processes.cross(x) @ weights).squeeze(-1).mT)


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

    log_variances: Processes
    log_variance: Weights
    rows: Processes
    """Processes of the coefficients of an output, for each output but the first; they share one kernel."""
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
        features = self.rows(x)
        unexplained = self.rows.unexplained(features)
        below, below_variance = (mean.new_zeros(*mean.shape, mean.shape[1]) for _ in range(2))
        # Coefficients of one output share their features, and each has a block of the weights.
        for i, (weights, own) in enumerate(zip(self.coefficients, features, strict=True), start=1):
            known = (own @ weights.root.reshape(i, own.shape[1], -1)).square().sum(-1).mT
            below[:, i, :i] = own @ weights.mean.reshape(i, -1).mT
            below_variance[:, i, :i] = known + unexplained[i - 1, :, None]
        return FactorMoments(mean, variance, below, below_variance)

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


def nearness(log_variances: Processes) -> Processes:
    """Process of unit variance without noise that tells how far data are.

    It has the length scale of the log variances (their mean, weighted by squared amplitudes), as far as that does not
    reach too far: a smooth process claims to know what is two of its length scales away, in gaps and beyond the data.
    """
    family, weight = log_variances.family, log_variances.amplitude.square()
    scale = ((weight / weight.sum()) @ log_variances.length_scale.log()).exp()
    least = 2.0 * spacing(family.inducing)
    if len(scale) == 1 and len(family.inducing) < _STATIONS:
        least = min(0.5, 2.0 * spacing(family.inducing, 0.75))
    scale = scale.clamp_max(_REACH * len(scale)).clamp_min(least)
    family = replace(family, fixed_length_scale=scale, kernel="squared_exponential", stretch=None)
    return replace(family, amplitude=1.0, constant=0.0).prepared(torch.zeros_like(log_variances.theta[:1]))


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


def log_correlation_moments(
    root: Float[Tensor, "n d r"], degrees: Float[Tensor, " n"], n_places: float, n_demos: int
) -> tuple[Float[Tensor, "d d"], Float[Tensor, ""]]:
    """What of the mean logarithm of correlations is taken for error, and the variance tau^2 of all logarithms.

    By moments: the mean square less that of the errors, of as many numbers as there are pairs of outputs and
    ``n_places`` independent places along a demonstration, and of one more, as of two outputs whose correlation may be
    anything. The mean is over these places, and errs as much less.
    """
    logarithm, _ = _log_correlation(root)
    i, j = torch.tril_indices(*logarithm.shape[1:], offset=-1, device=root.device)
    mean = logarithm.mean(0)

    def variance(square: Tensor, error: Tensor | float, number: float) -> Tensor:
        excess = square.mean() - error if square.numel() else square.new_zeros(())
        return ((number * excess + _UNIFORM) / (number + 1.0)).clamp_min(0.0)

    error = 1.0 / ((n_demos - 1) * max(n_places, 1.0))
    share = error / (variance(mean[i, j].square(), error, len(i)) + error)
    whole = variance(logarithm[:, i, j].square(), (1.0 / degrees).mean(), n_places * len(i))
    return share * mean, whole


def shrink_correlation(
    root: Float[Tensor, "n d r"],
    degrees: Float[Tensor, " n"],
    error: Float[Tensor, "d d"] | None,
    variance: Float[Tensor, ""],
    draws: Float[Tensor, "*s n d d"] | None = None,
) -> Float[Tensor, "*s n d d"]:
    """Roots with the correlations expected of a prior of this variance, the deviations as they are.

    The coefficients of an output have been shrunk by the fit, to an amplitude that is learned from all of them: of
    one, which tells little of it, the prior acts in full; the more there are, the more only the ``error`` of the mean
    along a demonstration is taken off, which the fit does not see. A file of before that has none.

    Of ``draws`` from the posterior without that prior, around this root, draws from the posterior with it.
    """
    logarithm, deviation = _log_correlation(root)
    weight = (variance / (variance + 1.0 / degrees))[:, None, None]
    shrunk = weight * logarithm
    if error is not None:
        more = max(0.5 * len(error) - 1.0, 0.0)  # coefficients of an output beyond the first, in the mean
        shrunk = (shrunk + more * (logarithm - error)) / (1.0 + more)
        weight = (weight + more) / (1.0 + more)
    if draws is not None:
        drawn, deviation = _log_correlation(draws)
        shrunk = shrunk + weight.sqrt() * (drawn - logarithm)
    half = spectral_map(0.5 * shrunk, torch.exp)
    return deviation / half.norm(dim=-1, keepdim=True) * half


def _log_correlation(root: Float[Tensor, "*s n d r"]) -> tuple[Float[Tensor, "*s n d d"], Float[Tensor, "*s n d 1"]]:
    """Logarithms of the correlations, and the deviations."""
    deviation = root.norm(dim=-1, keepdim=True)
    unit = root / deviation
    return spectral_map(unit @ unit.mT, lambda values: values.clamp_min(_LEAST_EIGENVALUE).log()), deviation
