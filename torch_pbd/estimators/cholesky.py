"""The Cholesky decomposition approach ("CD") of the paper, Section IV-D."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.estimators.latent import LatentCovarianceRegressor, Problem, warn_if_stretched
from torch_pbd.gp.observations import LatentGP, Observations, condition, longest_within
from torch_pbd.gp.search import fit_together
from torch_pbd.models.conditional import MeanAndCholesky
from torch_pbd.models.links import CholeskyLink
from torch_pbd.models.training import empirical_tril, mean_over_geometric, pooled_tril, residual_tril
from torch_pbd.optim.batch import FitReport

# The empirical diagonal is clamped to this share of its root mean square over the inputs before its logarithm is taken:
# an exact zero at one input, as where all recordings start at the origin, would dominate its neighbours. With 1e-3 the
# smoothed entries beside it err by more than their own size, and the snooker players lose 58 nats at their first step.
_LEAST_DIAGONAL = 1e-2
_LARGEST_NOISE = 1e100  # in standard deviations of y: float64 still holds its square


@dataclass(kw_only=True, eq=False, repr=False)
class CholeskyCovRegressor(LatentCovarianceRegressor):
    """Covariance by Gaussian processes on the entries of its Cholesky factor (the paper's "CD").

    One Gaussian process per output learns the mean of y, and one per entry the lower Cholesky factor of its
    covariance; far from data they return to the mean of y and to ``prior``.

    Parameters
    ----------
    objective : {"auto", "empirical", "likelihood"}, default="auto"
        "empirical" fits the processes to the Cholesky factors of the empirical covariances, with hyperparameters by
        marginal likelihood; it needs aligned data, every row of X at least twice. "likelihood" optimizes the factor at
        the inputs by L-BFGS, eq. (12), for any data. "auto" takes "empirical" where every input repeats.
    noise_scale : float or None, default=None
        Standard deviation of the error of the empirical factors' entries, in units of y; None learns it, and
        0.0 interpolates them, as Table I of the paper does. Only for "empirical".
    diagonal : {"auto", "raw", "log"}, default="auto"
        Whether the processes of the diagonal entries model the entries themselves, as in the paper, or their
        logarithms, which cannot cross zero between inputs. "auto" takes "raw" where ``noise_scale`` is given
        for "empirical", since it is the error of the entries themselves, and "log" otherwise.
    bias_correction : bool, default=False
        Divide the empirical factors by their expected share of the true ones for normal data (Bartlett). With few
        demonstrations they are too small: by 5 and 16 % for six of two outputs. Only for "empirical".
    {common}
    loss_ : float
        Negative log marginal likelihood of the factors' entries, in nats, for "empirical"; negative log posterior
        density (or likelihood) of the latent values, in nats per row, for "likelihood". Both for standardized y.

    References
    ----------
    Umlauft, Fanger, Hirche, "Bayesian Uncertainty Modeling for Programming by Demonstration", ICRA 2017,
    Section IV-D.

    Examples
    --------
    >>> from torch_pbd import CholeskyCovRegressor
    >>> from torch_pbd.data import make_paper_simulation
    >>> X, y, _ = make_paper_simulation(random_state=0)
    >>> model = CholeskyCovRegressor().fit(X, y)
    >>> mean, covariance = model.predict(X[:3], return_cov=True)
    >>> mean.shape, covariance.shape
    ((3, 2), (3, 2, 2))
    """

    _aligned_objective, _core_class = "empirical", MeanAndCholesky

    noise_scale: float | None = None
    diagonal: str = "auto"
    bias_correction: bool = False

    def _check_parameters(self) -> None:
        super()._check_parameters()
        checks.number(self.noise_scale, "noise_scale", least=0.0, optional=True)
        checks.flag(self.bias_correction, "bias_correction")
        checks.choice(self.diagonal, "diagonal", ("auto", "raw", "log"))

    def _fit_empirical(self, problem: Problem) -> tuple[MeanAndCholesky, FitReport, float]:
        training, smoothed = problem.training, self.noise_scale is None
        link = CholeskyLink(problem.prior_tril, self.diagonal == "log" or (self.diagonal == "auto" and smoothed))
        scale_tril = empirical_tril(training, bias_correction=self.bias_correction)
        linked = scale_tril
        if link.log_diagonal:
            diagonal = scale_tril.diagonal(dim1=-2, dim2=-1)
            diagonal = diagonal.maximum(_LEAST_DIAGONAL * diagonal.square().mean(0).sqrt())
            # Smoothed logarithms give the geometric mean of the entries, which for chi-distributed numbers is below
            # their mean by a known factor.
            diagonal = diagonal * mean_over_geometric(training) if smoothed else diagonal
            linked = scale_tril.tril(-1) + torch.diag_embed(diagonal)
        # The error of an entry of the factor from K rows has a variance proportional to 1 / (K - 1).
        degrees = training.counts - 1.0
        targets = link.deviation(linked).mT.contiguous()
        observations = Observations(training.inputs, targets, degrees / degrees.mean())
        longest, noise_scale = longest_within(training.inputs), self._entry_noise(problem)
        search = self._search(training.inputs, longest, problem.length_scale, noise_scale)
        mean_found, found = fit_together([self._mean_job(training), (observations, search)])
        warn_if_stretched(problem, found.hyperparameters, observations)
        mean, mean_report = self._fit_mean(training, mean_found)
        values = link.flatten(scale_tril).mT.contiguous()
        latent, jitter = condition(observations, found.hyperparameters, self.kernel, values, basis=found.basis)
        core = MeanAndCholesky(mean, latent, link.far(), bounded=smoothed)
        return core, found.report.after(mean_report, "search of the mean"), jitter

    def _entry_noise(self, problem: Problem) -> Tensor | None:
        """Noise of each entry of the factor, in standardized units; of a logarithm, relative."""
        if self.noise_scale is None:
            return None
        row, column = torch.tril_indices(*problem.prior_tril.shape[-2:], device=problem.prior_tril.device)
        noise = self.noise_scale / self._door(problem.scaling.y_scale)[row]
        if not bool((noise < _LARGEST_NOISE).all()):
            raise ValueError(
                f"noise_scale={self.noise_scale:g} is {float(noise.max()):.3g} times the deviation of y: give it in "
                "the units of y, or None to learn it."
            )
        if self.diagonal == "log":
            typical = pooled_tril(problem.training).diagonal().clamp_min(1e-6)[row]
            noise = torch.where(row == column, noise / typical, noise)
        return noise

    def _fit_likelihood(self, problem: Problem, mean: LatentGP) -> tuple[MeanAndCholesky, FitReport, float]:
        link, residual = CholeskyLink(problem.prior_tril, self.diagonal != "raw"), problem.training.residual(mean)
        root, latent, report = self._maximize(problem, link, residual, residual_tril(residual))
        processes = latent.interpolate(link.flatten(root).mT.contiguous())
        core = MeanAndCholesky(mean, processes, link.far(), bounded=self.latent_prior)
        return core, report, latent.jitter
