"""The recommended regressor: covariance from latent Gaussian processes that are integrated out."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.base import CovarianceRegressor, Fit
from torch_pbd.estimators.door import Integers, Prior, length_scale_in_ranges, period_in_ranges
from torch_pbd.estimators.validation import check_demonstrations, checked_queries, warn_if_few, warn_if_identical
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.files.memory import require_much
from torch_pbd.kernels import KERNELS, KernelName
from torch_pbd.models.heteroscedastic.fit import HeteroscedasticFit, fit_heteroscedastic
from torch_pbd.models.heteroscedastic.module import HeteroscedasticModel
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.residuals import are_copies
from torch_pbd.models.heteroscedastic.search import SearchOptions, candidate_families, check_memory, inducing_sizes

_DRAWN = 65536  # covariance matrices drawn at a time, to bound memory


@dataclass(kw_only=True, eq=False, repr=False)
class HeteroscedasticGPRegressor(CovarianceRegressor):
    """Mean and covariance by Gaussian processes, with the estimation error that few demonstrations leave.

    The covariance has a lower factor whose diagonal entries are exponentials of Gaussian processes of the input and
    whose other entries are Gaussian processes; d more model the mean. Their values are integrated out; their length
    scales and amplitudes maximize the evidence. The mean is refitted under the learned covariance by generalized least
    squares.

    The prediction is a Student's t. Its covariance contains the variability, the error of its estimate and
    that of the mean; far from data it is ``prior``.

    Parameters
    ----------
    kernel : {"squared_exponential", "matern32", "matern52", "periodic"}, default="squared_exponential"
        Kernel of all processes; "periodic" is the squared exponential of the chord on a circle.
    period : float or array-like of shape (n_features,), default=None
        Period of each input in units of X, such as 1.0 for a phase; ``inf`` for inputs that do not repeat. Required
        for "periodic" and allowed with the other kernels.
    prior : None, float, array-like of shape (d, d) or callable, default=None
        Covariance far from data, in squared units of y. A float multiplies the identity matrix; a callable
        maps X (n, e) to (n, d, d). None takes a wide one: four times the covariance of all of y.
    length_scale : float, array-like of shape (n_features,) or None, default=None
        Length scale of the covariance's processes, in units of X; None learns it.
    n_inducing : int or None, default=None
        Number of inducing inputs of the processes. None takes all distinct inputs up to 48, and the centres of 48
        clusters if there are more; 128 if the learned length scales come near the clusters' distances, or X has
        several columns. All outputs together have at most 400 (the mean 800). A mean that does not follow the data
        with these gets as many as its length scales need, at most 2048 for all outputs.
    max_inputs : int, default=512
        Largest number of distinct rows of X; if there are more, neighbours are merged. They are merged into fewer
        where samples of a demonstration are correlated, so that each input has rows of nearly all demonstrations. A
        mean that does not follow the data at these is fitted at up to 16384 / d of the distinct rows, with length
        scales searched on 1024 of them, which resolve about 170 cycles over the range.
    max_iter : int, default=100
        Largest number of BFGS iterations in each hyperparameter search.
    tol : float, default=1e-3
        Stop a search when no gradient entry exceeds it, or a step promises a gain below a hundredth of it, in nats.
    n_restarts : int, default=0
        Extra starts of the first searches, besides the best point of a small grid.
    random_state : int, RandomState instance or None, default=0
        Not used, since the fit is deterministic; present so that estimators are interchangeable.
    {common}
    loss_ : float
        Final negative log evidence of the covariance's processes, in nats, up to a constant; ``loss_curve_`` has it
        after each alternation of mean and covariance, for the residuals from the mean of that alternation.
    effective_share_ : float
        Effective number of independent samples per recorded sample, averaged over outputs; 1.0 without ``groups``.
    jitter_ : float
        Jitter of the kernel matrices, relative to their diagonal.

    Notes
    -----
    With n distinct inputs (at most ``max_inputs``), d outputs and m inducing inputs, of which smooth processes use an
    effective rank r, an evaluation of the evidence costs n d (d r)^2 + d (d r)^3, and an alternation once that with m
    for r. As d m is bounded by default, the cost grows linearly with many outputs.

    Where demonstrations start or end at one point, and the evidence favours it, the input of the covariance's
    processes is stretched there, so that their length scale is short only near that end. This needs a single column
    of X, and neither ``length_scale`` nor ``period``.

    With ``groups`` the correlation of a demonstration's residuals is estimated and enters the likelihood, since
    neighbouring samples are nearly copies. An exponential correlation of the same integral stands for the estimated
    one: demonstrations are smoother, but a model that trusts their smoothness takes it for signal. The tails of the
    predictive law then include the mean's error, and correlations are shrunk by their own errors.

    The fit depends on the order of the outputs and on the axes of their frame, as its factor does: with six
    demonstrations a variance was up to 4.4 times as large in a turned frame, or a tenth with the columns reversed, with
    more up to 2.4 times (``scripts/benchmarks/column_order.py``).

    References
    ----------
    Umlauft, Fanger, Hirche, "Bayesian Uncertainty Modeling for Programming by Demonstration", ICRA 2017: the problem,
    and the two kinds of uncertainty. Pourahmadi, "Joint mean-covariance models", Biometrika 86, 1999: the factor.

    Examples
    --------
    >>> from torch_pbd import HeteroscedasticGPRegressor
    >>> from torch_pbd.data import make_paper_simulation
    >>> X, y, groups = make_paper_simulation(random_state=0)
    >>> model = HeteroscedasticGPRegressor().fit(X, y, groups=groups)
    >>> mean, covariance = model.predict(X[:3], return_cov=True)
    >>> mean.shape, covariance.shape
    ((3, 2), (3, 2, 2))
    >>> model.sample_cov(X[:3], n_samples=5, random_state=0).shape
    (3, 2, 2, 5)
    """

    _core_class, _learned = HeteroscedasticModel, {"effective_share_": checks.number}

    kernel: KernelName | Literal["periodic"] = "squared_exponential"
    period: float | list[float] | None = None
    prior: Prior = None
    length_scale: float | list[float] | None = None
    n_inducing: int | None = None
    max_inputs: int = 512
    max_iter: int = 100
    tol: float = 1e-3
    n_restarts: int = 0
    random_state: Any = 0
    device: str | None = None
    verbose: int = 0

    def sample_cov(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw covariance functions from their posterior and evaluate them at X.

        Each draw is one function, so that its values at different inputs belong together. The spread of the draws is
        the uncertainty of the covariance; where data are missing every draw equals the prior, a single matrix.

        Parameters
        ----------
        X : array-like of shape (n_samples_X, n_features)
        n_samples : int, default=1
        random_state : int, RandomState instance or None, default=None

        Returns
        -------
        ndarray of shape (n_samples_X, n_outputs, n_outputs, n_samples)
        """
        checks.count(n_samples, "n_samples", least=1)
        generator = checks.seed(random_state)
        x = self._door(checked_queries(self, X))
        core: Any = self.module_.core
        require_much(
            8.0 * n_samples * (len(x) * self.n_outputs_**2 + 3 * sum(core.draw_sizes())),
            what=f"n_samples={n_samples} at {len(x)} rows",
            remedy="Draw fewer at a time.",
        )
        # Weights are drawn once, for all chunks of X: a draw is one function.
        normal = [[self._door(generator.standard_normal(size)) for size in core.draw_sizes()] for _ in range(n_samples)]
        drawn = [torch.stack(process) for process in zip(*normal, strict=True)]
        result = np.empty((len(x), self.n_outputs_, self.n_outputs_, n_samples))
        with torch.inference_mode():
            for rows in torch.arange(len(x)).split(max(1, _DRAWN // n_samples)):
                chunk = x[rows]
                draws = self.module_.draw_covariance(chunk, drawn, *self._prior_tril_at(chunk))
                result[rows.numpy()] = draws.permute(1, 2, 3, 0).cpu().numpy()
        return result

    def _check_parameters(self) -> None:
        super()._check_parameters()
        checks.choice(self.kernel, "kernel", (*KERNELS, "periodic"))
        if self.n_inducing is not None:
            checks.count(self.n_inducing, "n_inducing", least=2)
        checks.count(self.max_inputs, "max_inputs", least=2)

    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, order: Integers) -> Fit:
        if groups is None:
            warn_if_few(len(y), y.shape[1])
        else:
            check_demonstrations(X, y, groups)
        scaling, training = self._training_set(X, y)
        check_memory(self.n_inducing, self.max_inputs, (len(training.inputs), X.shape[1], y.shape[1]))
        length_scale = length_scale_in_ranges(self.length_scale, scaling.x_scale)
        period = period_in_ranges(self.period, self.kernel, scaling.x_scale)
        held, circle = (None if value is None else self._door(value) for value in (length_scale, period))
        prior_tril = self._prior_tril(training, scaling)
        identical = warn_if_identical(training) and groups is not None
        training = training if groups is None else training.without_near_inputs()
        # A mean that does not follow the data at the merged inputs is fitted anew, from all rows.
        rows, training = training, training.merged(self.max_inputs)
        group = None if groups is None else self._door(groups).long()
        options = SearchOptions(self.max_iter, self.tol, self.n_restarts, self._progress())
        kernel: KernelName = "squared_exponential" if self.kernel == "periodic" else self.kernel
        sizes = inducing_sizes(self.n_inducing, X.shape[1], y.shape[1])
        to_try = candidate_families(
            training.inputs, len(rows.inputs), sizes, kernel=kernel, period=circle, length_scale=held
        )
        begin_anew = rows if self.n_inducing is None else None
        fit = fit_heteroscedastic(training, group, to_try, options, rows=begin_anew, identical=identical)
        # A callable prior is asked again at every prediction.
        model = HeteroscedasticModel(fit, prior_tril if prior_tril.ndim == 2 else prior_tril[0])
        least = model.processes.covariance.log_variances.family.shortest_length_scale
        if held is not None and bool((held < least).any()):
            checks.warn(
                f"length_scale is below {least:.3g} of the range of X, which is what the inputs (or n_inducing of "
                "them) resolve: between them the covariance says nothing. Give a longer one, or None to learn it."
            )
        _warn_of_residuals(fit, self._door(order.argsort()).long())
        self.effective_share_ = 1.0 if fit.correlation is None else float(fit.correlation.share.mean())
        report = options.outcome(tuple(-value for value in fit.log_evidence))
        return model, scaling, report, ProcessFamily.jitter


def _warn_of_residuals(fit: HeteroscedasticFit, given: torch.Tensor) -> None:
    """Warn if rows ``given`` in this order without groups look like demonstrations, or the mean misses a signal."""
    if fit.group is None and are_copies(fit.whitened(), fit.training, given):
        checks.warn(
            "y has rows that nearly repeat those beside them along X, as samples of a demonstration do. Without groups "
            "they count as independent, and what is predicted is far too certain. Give groups, the demonstration of "
            "each row, to fit; cross_val_score takes params={'groups': groups}, and a search passes them on where "
            "metadata routing is enabled and set_fit_request(groups=True) asks for them.",
            DataRankWarning,
        )
    elif bool((missed := fit.missed()).any()):
        checks.warn(
            f"The mean does not follow y in outputs {missed.nonzero().flatten().tolist()}: what is left is no noise, "
            "but counts as such. Raise n_inducing and max_inputs; give groups if the rows are of demonstrations."
        )
