"""The Wishart process ("WP") of the paper, Section IV-A."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from sklearn.utils import check_random_state
from torch import Tensor

from torch_pbd import checks, gp
from torch_pbd.estimators.base import Prior
from torch_pbd.estimators.latent import (
    LatentCovarianceRegressor,
    Problem,
    longest_covariance,
    mean_consistent_with_repeats,
    residual_tril,
    warn_if_stretched,
)
from torch_pbd.exceptions import DataRankWarning, NotPositiveDefiniteError
from torch_pbd.gp.observations import FULL, Basis
from torch_pbd.kernels import KernelName
from torch_pbd.models.costs import Cost, FactorDistance, Likelihood
from torch_pbd.models.scoring import Solver, train_by_scoring
from torch_pbd.models.training import empirical_tril
from torch_pbd.models.wishart import MeanAndWishart, WishartCovariance, WishartLink, padded, wishart_root
from torch_pbd.optim import FitReport, minimize

_PAPER_MEAN = 8.0  # of all latent processes, in the paper's simulation
_FEW_ROWS = 8  # whose empirical deviation may by chance be near zero, so that what is drawn through it crosses zero
_CERTAIN = 1e-8  # ratio of noise: it keeps kernel matrices positive definite, and hides nothing
_SPREAD = {"empirical": 0.01, "random": 0.5}  # of the random part of whitened values at the start


@dataclass(kw_only=True, eq=False, repr=False)
class WishartProcessRegressor(LatentCovarianceRegressor):
    """Covariance as a Wishart process, a sum of outer products of Gaussian process vectors ("WP").

    The mean of y is learned by one Gaussian process an output, its covariance by ``df`` vectors of d
    processes at their means, eq. (8); far from data they return to the mean of y and to ``prior``.

    Parameters
    ----------
    objective : {"auto", "mse", "likelihood"}, default="auto"
        "mse": eq. (9), the mean squared distance of the Cholesky factors to those of the empirical
        covariances (aligned data: every row of X at least twice). "likelihood": eq. (11), for data anywhere.
        "auto" takes the first where every input repeats; where one has fewer than 8 rows with a noise that is
        learned, since interpolated vectors then cross zero.
    df : int, "auto" or None, default=None
        Number of vectors, the degrees of freedom nu; at least d. None or "auto" is d + 1.
    start : {"empirical", "random"}, default="empirical"
        "empirical": the vectors start at the columns of the empirical factors, where eq. (9) has its minimum,
        zero; for "likelihood" at those of the pooled covariance. "random": at the prior means with noise, and
        L-BFGS has all the way to go, as in the paper.
    latent_prior : bool, default=True
        Only for "likelihood". True maximizes the posterior density of the vectors at the inputs, whose prior means
        are then the pooled covariance's, with hyperparameters held. False is eq. (11) as printed, which trains them
        too and overfits: without bound where inputs do not repeat.
    solver : {"auto", "fisher", "lbfgs"}, default="auto"
        Of "likelihood" with ``latent_prior``, and of "mse" from a random start. "fisher" is Newton's method: with the
        Fisher information, expected or, where it is positive definite, observed; for "mse" with Gauss and Newton's
        matrix. "lbfgs" is torch's L-BFGS, slow in the valleys in which the vectors turn. "auto" takes "fisher", and
        "lbfgs" where more than 600 numbers, the rank of the kernel matrix times d times ``df``, would have to be
        solved for together. Without ``latent_prior`` it is L-BFGS always.
    kernel : {"squared_exponential", "matern32", "matern52"}, default="squared_exponential"
    prior : None, float, array-like of shape (d, d), callable or "paper", default=None
        Covariance far from data, in squared units of y. A float stands for that times the unit matrix; a
        callable maps X (n, e) to (n, d, d). None learns a wide one: four times the covariance of all of y.
        It is spread over the means of d of the vectors. "paper" sets the means of all to 8 in units of y,
        which gives a covariance of rank one far from data.
    length_scale : float, array-like of shape (n_features,) or None, default=None
        Of the vectors' processes, in units of X. None learns it for "mse" started at "empirical", and else
        takes a fifth of the range.
    max_inputs : int, default=256
        Where X has more distinct rows, neighbours are merged into this many: the cost of a fit is cubic in
        it and linear in the rows.
    max_iter : int, default=1000
    tol : float, default=1e-4
        Stop when no gradient entry, or the fall of the loss, is above it (1e-4 of it, for "mse").
    n_restarts : int, default=2
        Starting points of each hyperparameter search beside the first.
    random_state : int, RandomState instance or None, default=0
        Seed of the start.
    device : str or None, default=None
        Where the torch module lives.
    verbose : int, default=0

    Attributes
    ----------
    module_ : ConditionalNormal
        The fitted torch module: maps x (n, e) to mean (n, d) and Cholesky factor (n, d, d), differentiably.
    df_ : int
    n_features_in_, n_outputs_ : int
    loss_ : float
        "mse": eq. (9). "likelihood": negative log posterior density (or likelihood) of the latent values, in
        nats per row. Both of standardized y.
    loss_curve_ : list of float
    n_iter_ : int
    converged_ : bool
    jitter_ : float
        Largest jitter that a kernel matrix needed, relative to its diagonal.

    References
    ----------
    Umlauft, Fanger, Hirche, "Bayesian Uncertainty Modeling for Programming by Demonstration", ICRA 2017,
    Sections III-B and IV-A.
    """

    _aligned_objective = "mse"

    _core_class, _learned = MeanAndWishart, {"df_": checks.count}
    _costly = "df or max_inputs"

    objective: str = "auto"
    df: int | str | None = None
    start: str = "empirical"
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
        checks.choice(self.start, "start", tuple(_SPREAD))
        if self.df not in (None, "auto"):
            checks.count(self.df, "df", least=1)

    def _n_processes(self, n_outputs: int) -> int:
        df = n_outputs + 1 if self.df in (None, "auto") else int(self.df)
        return n_outputs * (df + 1)

    def _prior_root(self, problem: Problem) -> Tensor:
        """L times the vectors' prior means: (d, df), or (n, d, df) where the prior is callable."""
        n_outputs = problem.training.y.shape[1]
        self.df_ = n_outputs + 1 if self.df in (None, "auto") else int(self.df)
        if self.df_ < n_outputs:
            raise ValueError(
                f"df is {self.df_}, must be at least {n_outputs}, the number of outputs: the covariance of a "
                "Wishart process with fewer vectors is singular."
            )
        if isinstance(self.prior, str):
            return (_PAPER_MEAN * problem.prior_tril.diagonal())[:, None].repeat(1, self.df_)
        return padded(problem.prior_tril, self.df_)

    def _fit_empirical(self, problem: Problem) -> tuple[gp.LatentGP, WishartCovariance, FitReport, float]:
        job = self._mean_job(problem.training)
        mean, mean_report = mean_consistent_with_repeats(problem.training, *job, *gp.fit_together([job]))
        prior_root = self._prior_root(problem)
        target = empirical_tril(problem.training)
        cost = FactorDistance(WishartLink(prior_root), target)
        if self.start == "random":
            found, report, jitter = self._train(
                problem, prior_root, prior_root, cost, prior_weight=0.0, tol=1e-4 * self.tol
            )
            return mean, found, report.after(mean_report, "search of the mean"), jitter
        inputs, matrix = problem.training.inputs, torch.eye(target.shape[-1]).to(target)

        def observed(root: Tensor) -> gp.Observations:
            vectors = root.mT.flatten(1).mT.contiguous()
            return gp.merge_observations(
                gp.Observations(inputs, vectors, torch.ones_like(inputs[:, 0])), self.max_inputs
            )

        root = padded(target, self.df_)
        # The evidence of the vectors, not of their deviations: a prior far from them would allow for any swing.
        observations = observed(root)
        hyperparameters, report = self._smoothing(observations, problem)
        warn_if_stretched(hyperparameters.amplitude, observations.targets, given=problem.length_scale is not None)
        basis = Basis(observations, FULL)
        latent, jitter = gp.condition(observations, hyperparameters, self.kernel, basis=basis)
        # That the vectors are noisy is no reason for the prior to have a share in them where there are data.
        certain = replace(hyperparameters, noise_ratio=hyperparameters.noise_ratio.clamp_max(_CERTAIN))
        priors = observed(prior_root.expand_as(root))
        with torch.no_grad():
            latent.weight -= gp.condition(priors, certain, self.kernel, basis=basis)[0].weight
            mse = float(cost.at_root(wishart_root(latent(inputs), prior_root, matrix)))
        report = replace(report, loss=mse, loss_curve=(mse,)).after(mean_report, "search of the mean")
        prior = prior_root.reshape(-1, *root.shape[1:])[0]  # a callable one is handed in at every prediction
        return mean, WishartCovariance(latent, prior, matrix, bounded=True), report, jitter

    def _smoothing(self, observations: gp.Observations, problem: Problem) -> tuple[gp.Hyperparameters, FitReport]:
        """Hyperparameters without noise; with a learned one where "auto" has few rows, or inputs are too near."""

        def found(noise_scale: Tensor | None) -> tuple[gp.Hyperparameters, FitReport]:
            search = self._search(
                observations, longest_covariance(observations.inputs), problem.length_scale, noise_scale
            )
            hyperparameters, _, report = gp.fit_hyperparameters(observations, search)
            return hyperparameters, report

        if self.objective == "auto" and int(problem.training.counts.min()) < _FEW_ROWS:
            return found(None)
        try:
            return found(torch.zeros_like(observations.targets[:, 0]))
        except NotPositiveDefiniteError:
            checks.warn(
                "X has rows so near to each other that the empirical covariances at them cannot be interpolated: they "
                "are smoothed, with a noise that is learned. Make such rows equal, which pools their covariances.",
                DataRankWarning,
            )
            return found(None)

    def _fit_likelihood(self, problem: Problem, residual: Tensor) -> tuple[WishartCovariance, FitReport, float]:
        prior_root = self._prior_root(problem)
        training, n_rows = problem.training, len(residual)
        pooled = padded(residual_tril(residual), self.df_)
        # Around a prior far from them the vectors might swing through zero from one input to the next.
        centre = pooled if self.latent_prior else prior_root
        start = pooled if self.latent_prior or self.start == "empirical" else prior_root
        cost = Likelihood(WishartLink(centre), training.scatter_root(residual), training.counts, 1.0 / n_rows)
        return self._train(problem, centre, start, cost, prior_weight=1.0 / n_rows, tol=self.tol)

    def _train(
        self, problem: Problem, centre: Tensor, start: Tensor, cost: Cost, *, prior_weight: float, tol: float
    ) -> tuple[WishartCovariance, FitReport, float]:
        """Minimize a cost over the vectors' deviations from ``centre`` at the inputs.

        With ``latent_prior`` hyperparameters are held, and L is I; else they are trained too, as printed, and
        ``prior_weight`` does not count.
        """
        inputs, n_outputs, prior_root = problem.training.inputs, centre.shape[-2], self._prior_root(problem)
        # A free L would grow while the whitened values shrink, and so escape their prior.
        matrix = torch.eye(n_outputs).to(inputs).requires_grad_(not self.latent_prior)
        amplitude = centre.reshape(-1, n_outputs, self.df_).square().sum(-1).mean(0).sqrt().repeat(self.df_)
        latent = self._latent_values(problem, (start - centre).mT.flatten(-2), amplitude)
        # Vectors that start equal, or at zero, stay so by symmetry: tell them apart.
        generator = check_random_state(self.random_state)
        noise = self._door(generator.standard_normal(latent.whitened.shape))
        if self.start == "empirical":
            noise[: n_outputs * n_outputs] = 0.0
        with torch.no_grad():
            latent.whitened += _SPREAD[self.start] * noise
        limits: Any = {"max_iter": self.max_iter, "tol": tol, "callback": self._progress()}
        if self.latent_prior:
            report = train_by_scoring(cost, latent, prior_weight=prior_weight, solver=self.solver, **limits)
        else:
            trained = [*latent.trained(), matrix]
            report = minimize(lambda: cost.at_root(wishart_root(latent(), centre, matrix)), trained, **limits)
        with torch.no_grad():
            root = wishart_root(latent(), centre, matrix)
        values, deviations = (part.mT.flatten(1).mT.contiguous() for part in (root, root - prior_root))
        process = latent.interpolate(values, deviations if self.latent_prior else None)
        prior = prior_root.reshape(-1, *root.shape[1:])[0]
        covariance = WishartCovariance(process, prior, matrix.detach().tril(), bounded=self.latent_prior)
        return covariance, report, latent.jitter
