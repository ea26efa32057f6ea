"""The Cholesky decomposition approach ("CD") of the paper, Section IV-D."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.estimators.base import Prior
from torch_pbd.estimators.latent import (
    LatentCovarianceRegressor,
    Problem,
    longest_covariance,
    mean_consistent_with_repeats,
    residual_tril,
    warn_if_stretched,
)
from torch_pbd.gp import LatentGP, Observations, condition, fit_together
from torch_pbd.kernels import KernelName
from torch_pbd.linalg import tril_to_vector
from torch_pbd.models.cholesky import CholeskyCovariance, CholeskyLink, MeanAndCholesky, tril_deviation
from torch_pbd.models.costs import Likelihood
from torch_pbd.models.scoring import Solver, train_by_scoring
from torch_pbd.models.training import empirical_tril, mean_over_geometric, pooled_tril
from torch_pbd.optim import FitReport, minimize

# Logarithms of the empirical diagonal are taken of no less than this of its root mean square over the inputs:
# an exact zero at one input, as where all recordings start at the origin, would else dominate its neighbours.
_LEAST_DIAGONAL = 1e-3
_LARGEST_NOISE = 1e100  # in deviations of y: its square is a number

# Prior standard deviation of the logarithm of a diagonal entry: a factor of e^2 either way is usual.
_LOG_AMPLITUDE = 2.0


@dataclass(kw_only=True, eq=False, repr=False)
class CholeskyCovRegressor(LatentCovarianceRegressor):
    """Covariance by Gaussian processes on the entries of its Cholesky factor (the paper's "CD").

    The mean of y is learned by one Gaussian process an output, the lower Cholesky factor of its covariance
    by one an entry; far from data they return to the mean of y and to ``prior``.

    Parameters
    ----------
    objective : {"auto", "empirical", "likelihood"}, default="auto"
        "empirical": processes through the factors of the empirical covariances (aligned data: every row of
        X at least twice), hyperparameters by marginal likelihood. "likelihood": eq. (12), the factor at the
        inputs by L-BFGS, for data anywhere. "auto" takes the first where every input repeats.
    noise_scale : float or None, default=None
        Standard deviation, in units of y, of the error of the entries of the empirical factors; None learns
        it, 0.0 interpolates them, which is what Table I of the paper does. Only for "empirical".
    diagonal : {"auto", "raw", "log"}, default="auto"
        Whether the processes of the diagonal entries act on the entries themselves, as in the paper, or on
        their logarithm, which keeps them from crossing zero between inputs. "auto" takes "raw" where a
        ``noise_scale``, which is of entries, is given for "empirical", and else "log".
    bias_correction : bool, default=False
        Divide the empirical factors by their expectation for normal data (Bartlett), which few
        demonstrations make too small: six of two outputs by 5 and 16 %. Only for "empirical".
    latent_prior : bool, default=True
        Only for "likelihood". True maximizes the posterior density of the factor at the inputs, with
        hyperparameters held. False is eq. (12) as printed, which trains them too and overfits: without
        bound where inputs do not repeat.
    solver : {"auto", "fisher", "lbfgs"}, default="auto"
        Of "likelihood" with ``latent_prior``. "fisher" is Newton's method with the expected Fisher information,
        "lbfgs" is torch's L-BFGS, preconditioned with that information at the start: both end at the same optimum.
        "auto" takes "fisher", and "lbfgs" where more than 2500 numbers, the rank of the kernel matrix times d, would
        have to be solved for together. Without ``latent_prior`` it is L-BFGS always.
    kernel : {"squared_exponential", "matern32", "matern52"}, default="squared_exponential"
    prior : None, float, array-like of shape (d, d), callable or "paper", default=None
        Covariance far from data, in squared units of y. A float stands for that times the unit matrix; a
        callable maps X (n, e) to (n, d, d). None learns a wide one: four times the covariance of all of y.
        "paper" is a unit factor in the units of y.
    length_scale : float, array-like of shape (n_features,) or None, default=None
        Of the covariance's processes, in units of X. None learns it from aligned data, and else takes a
        fifth of the range.
    max_inputs : int, default=256
        Where X has more distinct rows, neighbours are merged into this many: the cost of a fit is cubic in it and
        linear in the rows. Aligned data on a line are merged only for length scales below a fortieth of the range;
        longer ones of the squared exponential are carried by 32 to 168 nodes, whatever the number of rows.
    max_iter : int, default=1000
    tol : float, default=1e-4
        Stop when no gradient entry, or the fall of the loss, is above it; in nats per row.
    n_restarts : int, default=2
        Starting points of each hyperparameter search beside the first.
    random_state : int, RandomState instance or None, default=0
        Not used: the fit is deterministic. It is here so that estimators can be exchanged.
    device : str or None, default=None
        Where the torch module lives.
    verbose : int, default=0

    Attributes
    ----------
    module_ : ConditionalNormal
        The fitted torch module: maps x (n, e) to mean (n, d) and Cholesky factor (n, d, d), differentiably.
    n_features_in_, n_outputs_ : int
    loss_ : float
        "empirical": negative log marginal likelihood of the factors' entries, in nats. "likelihood": negative
        log posterior density (or likelihood) of the latent values, in nats per row. Both of standardized y.
    loss_curve_ : list of float
    n_iter_ : int
    converged_ : bool
    jitter_ : float
        Largest jitter that a kernel matrix needed, relative to its diagonal.

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

    _aligned_objective = "empirical"

    _core_class = MeanAndCholesky

    objective: str = "auto"
    noise_scale: float | None = None
    diagonal: str = "auto"
    bias_correction: bool = False
    latent_prior: bool = True
    solver: Solver = "auto"
    kernel: KernelName = "squared_exponential"
    prior: Prior = None
    length_scale: float | list[float] | None = None
    max_inputs: int = 256
    max_iter: int = 1000
    tol: float = 1e-4
    n_restarts: int = 2
    random_state: Any = 0
    device: str | None = None
    verbose: int = 0

    def _check_parameters(self) -> None:
        super()._check_parameters()
        checks.number(self.noise_scale, "noise_scale", least=0.0, optional=True)
        checks.flag(self.bias_correction, "bias_correction")
        checks.choice(self.diagonal, "diagonal", ("auto", "raw", "log"))

    def _fit_empirical(self, problem: Problem) -> tuple[LatentGP, CholeskyCovariance, FitReport, float]:
        training, smoothed = problem.training, self.noise_scale is None
        log_diagonal = self.diagonal == "log" or (self.diagonal == "auto" and smoothed)
        scale_tril = empirical_tril(training, bias_correction=self.bias_correction)
        linked = scale_tril
        if log_diagonal:
            diagonal = scale_tril.diagonal(dim1=-2, dim2=-1)
            diagonal = diagonal.maximum(_LEAST_DIAGONAL * diagonal.square().mean(0).sqrt())
            # Smoothed logarithms give the geometric mean of the entries, which for chi numbers is below their mean by a
            # factor that is known.
            diagonal = diagonal * mean_over_geometric(training) if smoothed else diagonal
            linked = scale_tril.tril(-1) + torch.diag_embed(diagonal)
        deviation = tril_deviation(linked, problem.prior_tril, log_diagonal=log_diagonal)
        # An entry of the factor of K rows has an error whose variance falls with K - 1.
        degrees = training.counts - 1.0
        observations = Observations(training.inputs, deviation.mT.contiguous(), degrees / degrees.mean())
        noise_scale = self._entry_noise(problem)
        search = self._search(observations, longest_covariance(training.inputs), problem.length_scale, noise_scale)
        mean_job = self._mean_job(training)
        mean_found, entries_found = fit_together([mean_job, (observations, search)])
        amplitude = entries_found.hyperparameters.amplitude
        warn_if_stretched(amplitude, observations.targets, given=problem.length_scale is not None)
        mean, mean_report = mean_consistent_with_repeats(training, *mean_job, mean_found)
        values = tril_to_vector(scale_tril).mT.contiguous()
        found = (entries_found.hyperparameters, self.kernel, values)
        latent, jitter = condition(observations, *found, basis=entries_found.basis)
        prior = problem.prior_tril if problem.prior_tril.ndim == 2 else problem.prior_tril[0]
        report = entries_found.report.after(mean_report, "search of the mean")
        covariance = CholeskyCovariance(latent, prior, log_diagonal=log_diagonal, bounded=smoothed)
        return mean, covariance, report, jitter

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

    def _fit_likelihood(self, problem: Problem, residual: Tensor) -> tuple[CholeskyCovariance, FitReport, float]:
        training, log_diagonal = problem.training, self.diagonal != "raw"
        pooled = residual_tril(residual).expand_as(problem.prior_tril)
        start = tril_deviation(pooled, problem.prior_tril, log_diagonal=log_diagonal)
        prior = problem.prior_tril.reshape(-1, *problem.prior_tril.shape[-2:])
        row, column = torch.tril_indices(*prior.shape[-2:], device=prior.device)
        # A priori an entry deviates by as much as its row of the prior's factor is long, the output's prior deviation.
        amplitude = prior.square().sum(-1).mean(0).sqrt()[row]
        if log_diagonal:
            amplitude = torch.where(row == column, _LOG_AMPLITUDE, amplitude)
        latent = self._latent_values(problem, start, amplitude)
        link, n_rows = CholeskyLink(problem.prior_tril, log_diagonal), len(residual)
        cost = Likelihood(link, training.scatter_root(residual), training.counts, 1.0 / n_rows)
        limits: Any = {"max_iter": self.max_iter, "tol": self.tol, "callback": self._progress()}
        if self.latent_prior:
            report = train_by_scoring(cost, latent, prior_weight=1.0 / n_rows, solver=self.solver, **limits)
        else:
            report = minimize(lambda: cost(latent()), latent.trained(), **limits)
        with torch.no_grad():
            scale_tril = link.root(latent())
        gp = latent.interpolate(tril_to_vector(scale_tril).mT.contiguous())
        covariance = CholeskyCovariance(gp, prior[0], log_diagonal=log_diagonal, bounded=self.latent_prior)
        return covariance, report, latent.jitter
