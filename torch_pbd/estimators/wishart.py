"""The Wishart process ("WP") of the paper, Section IV-A."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.estimators.latent import LatentCovarianceRegressor, Problem, warn_if_stretched
from torch_pbd.exceptions import DataRankWarning, NotPositiveDefiniteError
from torch_pbd.gp.observations import LatentGP, Observations, condition, longest_within, merge_observations
from torch_pbd.gp.search import Found, fit_together
from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models import with_floor
from torch_pbd.models.conditional import MeanAndWishart
from torch_pbd.models.links import WishartLink, padded
from torch_pbd.models.training import empirical_tril, residual_tril
from torch_pbd.optim.batch import FitReport

_PAPER_MEAN = 8.0  # prior mean of all latent processes in the paper's simulation
_FEW_ROWS = 8  # fewer rows may by chance have a deviation near zero, through which interpolated vectors cross zero
_CERTAIN = 1e-8  # noise ratio that keeps kernel matrices positive definite and is otherwise negligible


@dataclass(kw_only=True, eq=False, repr=False)
class WishartProcessRegressor(LatentCovarianceRegressor):
    """Covariance as a Wishart process, a sum of outer products of Gaussian process vectors ("WP").

    One Gaussian process per output learns the mean of y; ``df`` vectors of d processes, at their means, give its
    covariance, eq. (8). Far from data they return to the mean of y and to ``prior``.

    Parameters
    ----------
    objective : {"auto", "mse", "likelihood"}, default="auto"
        "mse" minimizes eq. (9), the mean squared distance of the Cholesky factors to the empirical ones; it needs
        aligned data, every row of X at least twice. Its minimum is zero, where the vectors are the columns of the
        empirical factors. "likelihood" maximizes eq. (11) for any data, starting from the pooled covariance, which is
        then the prior of the vectors too. "auto" takes "mse" where every input repeats, with a learned noise if an
        input has fewer than 8 rows, since interpolated vectors then cross zero.
    df : int, "auto" or None, default=None
        Number of vectors, the degrees of freedom nu, at least d; None or "auto" is d + 1.
    {common}
    df_ : int
    loss_ : float
        Eq. (9) for "mse"; negative log posterior density (or likelihood) of the latent values, in nats per row, for
        "likelihood". Both for standardized y.

    References
    ----------
    Umlauft, Fanger, Hirche, "Bayesian Uncertainty Modeling for Programming by Demonstration", ICRA 2017,
    Sections III-B and IV-A.
    """

    _aligned_objective, _core_class, _learned = "mse", MeanAndWishart, {"df_": checks.count}
    _costly = "df or max_inputs"

    df: int | str | None = None

    def _check_parameters(self) -> None:
        super()._check_parameters()
        if self.df not in (None, "auto"):
            checks.count(self.df, "df", least=1)

    def _n_processes(self, n_outputs: int) -> int:
        df = n_outputs + 1 if self.df in (None, "auto") else int(self.df)
        return n_outputs * (df + 1)

    def _prior_root(self, problem: Problem) -> Tensor:
        """L times the vectors' prior means: (d, df), or (n, d, df) where the prior is callable."""
        n_outputs = problem.training.y.shape[1]
        self.df_ = self._n_processes(n_outputs) // n_outputs - 1
        if self.df_ < n_outputs:
            raise ValueError(
                f"df is {self.df_}, must be at least {n_outputs}, the number of outputs: the covariance of a "
                "Wishart process with fewer vectors is singular."
            )
        if isinstance(self.prior, str):
            return (_PAPER_MEAN * problem.prior_tril.diagonal())[:, None].repeat(1, self.df_)
        return padded(problem.prior_tril, self.df_)

    def _fit_empirical(self, problem: Problem) -> tuple[MeanAndWishart, FitReport, float]:
        mean, mean_report = self._fit_mean(problem.training)
        inputs, target = problem.training.inputs, empirical_tril(problem.training)
        link = WishartLink(self._prior_root(problem))
        root = padded(target, self.df_)

        def observed(root: Tensor) -> Observations:
            vectors = Observations(inputs, link.flatten(root).mT.contiguous(), torch.ones_like(inputs[:, 0]))
            return merge_observations(vectors, self.max_inputs)

        # Evidence of the vectors themselves, not of their deviations from the prior: a far prior would allow any swing.
        observations = observed(root)
        hyperparameters, _, report, _ = self._smoothing(observations, problem)
        warn_if_stretched(problem, hyperparameters, observations)
        latent, jitter = condition(observations, hyperparameters, self.kernel)
        # Noise of the vectors must not pull them towards the prior where there are data.
        certain = replace(hyperparameters, noise_ratio=hyperparameters.noise_ratio.clamp_max(_CERTAIN))
        with torch.no_grad():
            latent.weight -= condition(observed(link.prior.expand_as(root)), certain, self.kernel)[0].weight
            difference = scale_tril_from_root(with_floor(link.root(latent(inputs)))) - target
            mse = float(difference.square().sum((-2, -1)).mean())  # eq. (9)
        report = replace(report, loss=mse, loss_curve=(mse,)).after(mean_report, "search of the mean")
        return MeanAndWishart(mean, latent, link.far(), bounded=True), report, jitter

    def _smoothing(self, observations: Observations, problem: Problem) -> Found:
        """Hyperparameters without noise, or with a learned one where "auto" has few rows or inputs are too near."""
        inputs, none = observations.inputs, torch.zeros_like(observations.targets[:, 0])

        def found(noise_scale: Tensor | None) -> Found:
            search = self._search(inputs, longest_within(inputs), problem.length_scale, noise_scale)
            return fit_together([(observations, search)])[0]

        if self.objective == "auto" and int(problem.training.counts.min()) < _FEW_ROWS:
            return found(None)
        try:
            return found(none)
        except NotPositiveDefiniteError:
            checks.warn(
                "X has rows so near to each other that the empirical covariances at them cannot be interpolated: they "
                "are smoothed, with a noise that is learned. Make such rows equal, which pools their covariances.",
                DataRankWarning,
            )
            return found(None)

    def _fit_likelihood(self, problem: Problem, mean: LatentGP) -> tuple[MeanAndWishart, FitReport, float]:
        prior_root, residual = self._prior_root(problem), problem.training.residual(mean)
        pooled = padded(residual_tril(residual), self.df_)
        # Around a distant prior the vectors might swing through zero between inputs. A free L would grow while the
        # whitened values shrink, and so escape their prior.
        link = WishartLink(pooled)
        if not self.latent_prior:
            link = WishartLink(prior_root, scale_matrix_tril=torch.eye(len(pooled)).to(pooled).requires_grad_())
        # Vectors that start equal, or at zero, stay so by symmetry: noise separates those after the first d.
        root, latent, report = self._maximize(problem, link, residual, pooled, first_random=len(pooled) ** 2)
        link = WishartLink(prior_root, scale_matrix_tril=link.scale_matrix_tril)
        deviations = link.deviation(root).mT.contiguous() if self.latent_prior else None
        processes = latent.interpolate(link.flatten(root).mT.contiguous(), deviations)
        return MeanAndWishart(mean, processes, link.far(), bounded=self.latent_prior), report, latent.jitter
