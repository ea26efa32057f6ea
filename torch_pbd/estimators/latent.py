"""Base of the two regressors on latent Gaussian processes (CD and WP), and the mean that both share."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.special import fdtri, stdtrit
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.base import COMMON, CovarianceRegressor, Fit
from torch_pbd.estimators.door import Integers, Prior, Standardization, length_scale_in_ranges
from torch_pbd.estimators.validation import warn_if_few, warn_if_identical
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.files.memory import require_much
from torch_pbd.gp.evidence import EvidenceSearch
from torch_pbd.gp.observations import (
    SHORTEST,
    Hyperparameters,
    LatentGP,
    Observations,
    condition,
    longest_within,
    resolved_length_scale,
    spacing,
)
from torch_pbd.gp.search import Found, Job, fit_together
from torch_pbd.kernels import KERNELS, KernelName, default_length_scale
from torch_pbd.models.conditional import MeanAndCovariance
from torch_pbd.models.costs import LatentValues, Likelihood, Solver, train
from torch_pbd.models.links import Link
from torch_pbd.models.training import TrainingSet
from torch_pbd.optim.batch import FitReport

# A process is stretched if its amplitude exceeds its values by this factor; where it can follow them it is up to 2.
_STRETCHED = 10.0
_LONGEST_MEAN = 10.0  # length scale of a mean, in ranges of the inputs

_LEVEL = 1e-4  # significance level of the lack-of-fit tests: how often a right mean is rejected
_CLEAR = 5.0  # standard errors that always reject a mean: with two rows at two inputs the t test would allow 100
_LEAST_SPREAD = 0.03  # smallest credible spread at one input, as a share of the pooled spread
_UNRESOLVED = 1e-10  # squared error in standardized outputs that a smooth process may always have
_SPREAD = 0.01  # standard deviation of the random part of whitened values at the start
_SHARE, _LEAST_NOISE = 0.1, 1e-6  # noise of a mean: share of its smallest error, and least share of the outputs' scale

_COMMON = f"""latent_prior : bool, default=True
    Only for "likelihood". True maximizes the posterior density of the processes at the inputs, hyperparameters fixed;
    False the paper's likelihood, which trains these too and overfits, without bound where inputs do not repeat.
solver : {{"auto", "fisher", "lbfgs"}}, default="auto"
    Only for "likelihood". "fisher" is Newton's method with the Fisher information, "lbfgs" torch's L-BFGS,
    preconditioned with the initial one; both reach the same optimum. "auto" takes "fisher", but "lbfgs" above 2500
    unknowns for CD, the rank of the kernel matrix times d, and above 600 for WP, that times ``df``. Without
    ``latent_prior`` it is always L-BFGS.
kernel : {{"squared_exponential", "matern32", "matern52"}}, default="squared_exponential"
prior : None, float, array-like of shape (d, d), callable or "paper", default=None
    Covariance far from data, in squared units of y. A float multiplies the identity matrix; a callable maps
    X (n, e) to (n, d, d). None takes a wide one: four times the covariance of all of y. "paper" is an identity
    factor in the units of y for CD, and vectors whose means are all 8 for WP, which give a covariance of rank one.
length_scale : float, array-like of shape (n_features,) or None, default=None
    Length scale of the covariance's processes, in units of X. None learns it from empirical covariances; otherwise it
    takes a fifth of the range, times the root of the number of inputs, or with few rows more.
max_inputs : int, default=256
    Largest number of distinct rows of X; if there are more, neighbours are merged. A fit costs the cube of it, and is
    linear in the rows. CD merges aligned data over one input only for length scales below a fortieth of the range;
    the squared exponential of longer ones is represented by 32 to 168 nodes, whatever the number of rows.
max_iter : int, default=1000
tol : float, default=1e-4
    Stop when no gradient entry, or the decrease of the loss, exceeds it, in nats per row.
n_restarts : int, default=2
    Extra starting points of each hyperparameter search.
random_state : int, RandomState instance or None, default=0
    Seed of the initial values of a Wishart process with "likelihood"; other fits are deterministic.
{COMMON}
jitter_ : float
    Largest jitter that a kernel matrix needed, relative to its diagonal."""


@dataclass(frozen=True)
class Problem:
    """A fit in standardized units."""

    training: TrainingSet
    scaling: Standardization
    prior_tril: Tensor
    length_scale: Tensor | None
    """(e,), where the user gave it."""


@dataclass(kw_only=True, eq=False, repr=False)
class LatentCovarianceRegressor(CovarianceRegressor):
    """Base of CD and WP: mean by d Gaussian processes, covariance by more of them; not for direct use."""

    _common = _COMMON
    _aligned_objective: ClassVar[str]
    """Value of ``objective`` that works on empirical covariances."""
    _costly: ClassVar = "max_inputs"
    """Parameters that decide on the memory."""

    objective: str = "auto"
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
        checks.choice(self.objective, "objective", ("auto", self._aligned_objective, "likelihood"))
        checks.choice(self.kernel, "kernel", tuple(KERNELS))
        checks.count(self.max_inputs, "max_inputs", least=2)
        if isinstance(self.prior, str):
            checks.choice(self.prior, "prior", ("paper",))
        checks.choice(self.solver, "solver", Solver)
        if not checks.flag(self.latent_prior, "latent_prior") and self.solver == "fisher":
            raise ValueError(
                "solver='fisher' holds the hyperparameters, which latent_prior=False trains: use solver='auto'."
            )

    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, order: Integers) -> Fit:
        scaling, training = self._training_set(X, y)
        n_inputs, n_processes = min(len(training.inputs), self.max_inputs), self._n_processes(y.shape[1])
        require_much(
            8.0 * n_inputs**2 * n_processes * 4,
            what=f"max_inputs={self.max_inputs} lets {n_inputs} distinct inputs into kernel matrices of "
            f"{n_processes} processes, which",
            remedy=f"Lower {self._costly}.",
        )
        counts = training.counts.cpu().numpy()
        aligned = self._works_on_empirical(scaling.in_units(training.inputs.cpu().numpy()), counts, y.shape[1])
        length_scale = length_scale_in_ranges(self.length_scale, scaling.x_scale)
        if not aligned:
            # Where every input repeats, its rows have been counted already.
            warn_if_few(len(y), y.shape[1], groups if counts.min() < 2 else None)
            training = training.merged(self.max_inputs)
        held = None if length_scale is None else self._door(length_scale)
        problem = Problem(training, scaling, self._prior_tril(training, scaling), held)
        warn_if_identical(training)
        if aligned:
            core, report, jitter = self._fit_empirical(problem)
        else:
            mean, mean_report = self._fit_mean(training)
            core, report, jitter = self._fit_likelihood(problem, mean)
            report = report.after(mean_report, "search of the mean")
        return core, scaling, report, jitter

    @abstractmethod
    def _fit_empirical(self, problem: Problem) -> tuple[MeanAndCovariance, FitReport, float]:
        """Core by the empirical covariances of aligned data, and its jitter."""

    @abstractmethod
    def _fit_likelihood(self, problem: Problem, mean: LatentGP) -> tuple[MeanAndCovariance, FitReport, float]:
        """Core by maximum likelihood of the residuals from the mean, and its jitter."""

    def _works_on_empirical(self, inputs: Floats, counts: Any, n_outputs: int) -> bool:
        """Decide the objective, by the distinct inputs and their counts."""
        fewest = int(counts.min())
        aligned = self.objective != "likelihood" and fewest >= 2
        if self.objective == self._aligned_objective and not aligned:
            raise ValueError(
                f"objective={self.objective!r} needs >= 2 demonstrations at each input, got 1 at X = "
                f"{inputs[np.argmin(counts)].tolist()} ({int((counts < 2).sum())} of {len(inputs)} inputs have one "
                "row). Align the demonstrations, record more, or use objective='likelihood'."
            )
        if 2 <= fewest <= n_outputs:
            what = "that empirical covariance is singular, and is shrunk towards the pooled covariance"
            if not aligned:
                what = "the likelihood takes for certain what was only not seen to vary; objective='auto' shrinks it"
            checks.warn(
                f"y has {fewest} demonstrations at an input but {n_outputs} outputs: {what}. {n_outputs + 1} or more "
                "demonstrations determine the covariance.",
                DataRankWarning,
            )
        return aligned

    def _prior_tril(self, training: TrainingSet, scaling: Standardization) -> Tensor:
        if isinstance(self.prior, str):  # "paper": the entries of the factor are in the units of y
            return torch.diag(1.0 / self._door(scaling.y_scale))
        return super()._prior_tril(training, scaling)

    def _search(
        self, inputs: Tensor, longest: float, length_scale: Tensor | None = None, noise_scale: Tensor | None = None
    ) -> EvidenceSearch:
        shortest = resolved_length_scale(inputs)
        if noise_scale is not None and not bool((noise_scale > 0).any()):
            # A longer length scale than where inputs are closest makes an interpolating process swing between others.
            shortest = min(0.5, max(1e-6, SHORTEST * spacing(inputs, 0.1)))
        limits = self.max_inputs, self.n_restarts, max(100, self.max_iter)
        return EvidenceSearch(self.kernel, (shortest, longest), length_scale, noise_scale, *limits)

    def _mean_job(self, training: TrainingSet) -> Job:
        """Means at the inputs, weighted by their counts, and the search for their hyperparameters."""
        weights = training.counts / training.counts.mean()
        observations = Observations(training.inputs, training.means.mT.contiguous(), weights)
        return observations, self._search(training.inputs, _LONGEST_MEAN)

    def _fit_mean(self, training: TrainingSet, found: Found | None = None) -> tuple[LatentGP, FitReport]:
        """Processes by evidence, or through the means where rows that repeat inputs contradict these.

        The evidence sees the mean at each input, not how far the rows there differ: with few inputs, or jumps between
        them, it may take for noise what all demonstrations agree on. A process that would swing far beyond the means
        between the inputs to follow them is rejected with a warning.
        """
        observations, search = self._mean_job(training)
        found = fit_together([(observations, search)])[0] if found is None else found
        mean, _ = condition(observations, found.hyperparameters, self.kernel, basis=found.basis)
        if int(training.counts.min()) < 2 or not training.repeats_inputs:
            return mean, found.report
        with torch.no_grad():
            wrong, least_error = _contradicted(training, observations.targets - mean(training.inputs).mT)
        if not bool(wrong.any()):
            return mean, found.report
        learned = found.hyperparameters.amplitude * found.hyperparameters.noise_ratio.sqrt()
        noise_scale = torch.where(wrong, _SHARE * least_error, learned).clamp_min(_LEAST_NOISE)
        (again,) = fit_together([(observations, replace(search, noise_scale=noise_scale))])
        # Over a range or more a large amplitude is a trend.
        short = again.hyperparameters.length_scale.amin(1) < 1.0
        swings = short & _is_stretched(again.hyperparameters, observations)
        if bool(swings[wrong].any()):
            checks.warn(
                "y has means at the inputs that differ by more than its scatter there, between inputs too near to each "
                "other for a smooth mean to follow: it does not. Make such rows of X equal, which pools them.",
                DataRankWarning,
            )
            return mean, found.report
        return condition(observations, again.hyperparameters, self.kernel, basis=again.basis)[0], again.report

    @torch.no_grad()
    def _maximize(
        self, problem: Problem, link: Link, residual: Tensor, start: Tensor, first_random: int | None = None
    ) -> tuple[Tensor, LatentValues, FitReport]:
        """Roots at the inputs at the maximum of the likelihood, and the latent values there.

        Training starts from a root, of processes from ``first_random`` on a little beside it. Length scales default to
        a fifth of the range of the inputs, to less beside a gap in them, and to more of few rows.
        """
        training, length_scale = problem.training, problem.length_scale
        n_inputs, n_features = training.inputs.shape
        if length_scale is None:
            length = default_length_scale(n_features, len(residual) if self.latent_prior else None)
            length = min(length, longest_within(training.inputs)) if n_features == 1 else length
            length_scale = training.inputs.new_full((n_features,), length)
        deviation = link.deviation(start).expand(n_inputs, -1).mT.contiguous()
        options: Any = {"kernel": self.kernel, "train_hyperparameters": not self.latent_prior}
        latent = LatentValues(training.inputs, deviation, link.amplitude(), length_scale[None], **options)
        if first_random is not None:
            noise = self._door(checks.seed(self.random_state).standard_normal(latent.whitened.shape))
            latent.whitened[first_random:] += _SPREAD * noise[first_random:]
        likelihood = Likelihood(link, training.scatter_root(residual), training.counts, 1.0 / len(residual))
        report = train(likelihood, latent, self.solver, self.max_iter, self.tol, self._progress())
        return link.root(latent()), latent, report

    def _n_processes(self, n_outputs: int) -> int:
        return (n_outputs + 1) ** 2


def _is_stretched(hyperparameters: Hyperparameters, observations: Observations) -> Bool[Tensor, " b"]:
    """Whether each process follows its targets only as the difference of large numbers."""
    return hyperparameters.amplitude > _STRETCHED * observations.targets.square().mean(1).sqrt().clamp_min(1e-12)


def warn_if_stretched(problem: Problem, hyperparameters: Hyperparameters, observations: Observations) -> None:
    """Warn where a length scale that the user gave is too long for what changes over the inputs."""
    if problem.length_scale is not None and bool(_is_stretched(hyperparameters, observations).any()):
        checks.warn(
            "length_scale is so long that the covariance follows the data only as the difference of large numbers: "
            "beside the data it will overshoot the prior. Give a shorter one, or None to learn it."
        )


def _contradicted(
    training: TrainingSet, residual: Float[Tensor, "d n"]
) -> tuple[Bool[Tensor, " d"], Float[Tensor, " d"]]:
    """Whether a process misses the means at the inputs, and the smallest standard error of a mean.

    All inputs together are tested by the F test of lack of fit, each single one by Student's t.
    """
    counts, squares = training.counts, training.squares
    degrees = counts - 1.0
    pooled = squares.sum(0) / degrees.sum()
    local = torch.maximum(squares / degrees[:, None], _LEAST_SPREAD**2 * pooled)
    squared, n_inputs = residual.mT.square() * counts[:, None], len(counts)
    limit = min(float(fdtri(n_inputs, float(degrees.sum()), 1.0 - _LEVEL)), _CLEAR**2)
    together = squared.mean(0) > limit * pooled + _UNRESOLVED
    each = squared.new_tensor(stdtrit(degrees.cpu().numpy(), 0.5 * _LEVEL / n_inputs))
    alone = squared > each.square()[:, None] * local + _UNRESOLVED
    # The evidence counts rows by their mean count, and so does this error.
    return together | alone.any(0), (local.amin(0) / counts.mean()).sqrt()
