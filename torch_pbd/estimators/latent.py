"""Base of the two regressors on latent Gaussian processes (CD and WP), and the mean that both have."""

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
from torch_pbd.estimators.base import CovarianceRegressor, check_length_scale, standardized_prior
from torch_pbd.estimators.torch_estimator import Fitted, Integers, Standardization
from torch_pbd.estimators.validation import warn_if_few, warn_if_identical
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.files.memory import require_much
from torch_pbd.gp import (
    EvidenceSearch,
    LatentGP,
    LatentValues,
    Observations,
    condition,
    fit_together,
    resolved_length_scale,
    spacing,
)
from torch_pbd.gp.search import Found
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import safe_cholesky, scale_tril_from_root
from torch_pbd.models.conditional import MeanAndCovariance
from torch_pbd.models.scoring import Solver
from torch_pbd.models.training import TrainingSet, default_prior_tril
from torch_pbd.optim import FitReport

# An amplitude of so many times the values: where a process can follow them it is up to 2.
_STRETCHED = 10.0
# Spacings of the inputs that an interpolating process may be as short as, and ranges that others may be as long as:
# with longer ones the prior of a covariance would never take over.
_SHORTEST, _LONGEST_MEAN, _LONGEST_COVARIANCE = 0.75, 10.0, 0.35
# A hole among inputs on a line, of the range and in spacings of the others. It is to hold so many length scales: a
# smooth process without noise claims to know what is two to three of them from many inputs.
_HOLE, _SPACINGS, _IN_HOLE = 0.25, 5.0, 6.0

_LEVEL = 1e-4  # of the tests: how often a mean that is right is taken for wrong
_CLEAR = 5.0  # standard errors of the means, however few rows tell them: of twice two the test would allow for 100
_LEAST_SPREAD = 0.03  # of the pooled one: how small that at an input is believed to be
_UNRESOLVED = 1e-10  # squared, of standardized outputs: what a smooth process may be off by in any case
_SHARE, _LEAST_NOISE = 0.1, 1e-6  # of the smallest error of a mean, and of the outputs' deviation


@dataclass(frozen=True)
class Problem:
    """A fit in standardized units."""

    training: TrainingSet
    scaling: Standardization
    prior_tril: Tensor
    """(d, d), or (n, d, d) at the training inputs where the prior is callable."""
    length_scale: Tensor | None
    """(e,), where the user gave it."""


class LatentCovarianceRegressor(CovarianceRegressor):
    """Base of CD and WP: mean by d Gaussian processes, covariance by more of them; not for direct use."""

    _aligned_objective: str
    """Value of ``objective`` that works on empirical covariances."""

    _core_class: ClassVar[type[MeanAndCovariance]]
    _costly = "max_inputs"
    """Parameters that decide on the memory."""

    objective: str
    prior: Any
    kernel: Any
    length_scale: Any
    max_inputs: int
    latent_prior: bool
    solver: Solver

    def _check_parameters(self) -> None:
        super()._check_parameters()
        checks.choice(self.objective, "objective", ("auto", self._aligned_objective, "likelihood"))
        checks.choice(self.kernel, "kernel", tuple(KERNELS))
        checks.count(self.max_inputs, "max_inputs", least=2)
        if isinstance(self.prior, str):
            checks.choice(self.prior, "prior", ("paper",))
        checks.choice(self.solver, "solver", ("auto", "fisher", "lbfgs"))
        if not checks.flag(self.latent_prior, "latent_prior") and self.solver == "fisher":
            raise ValueError(
                "solver='fisher' holds the hyperparameters, which latent_prior=False trains: use solver='auto' or "
                "'lbfgs', or latent_prior=True."
            )

    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, recorded: Integers) -> Fitted:
        scaling, training = self._training_set(X, y)
        counts = training.counts.cpu().numpy()
        aligned = self._works_on_empirical(_in_units(training, scaling), counts, y.shape[1])
        length_scale = check_length_scale(self.length_scale, X.shape[1])
        if not aligned:
            # Those that repeat inputs have been counted.
            warn_if_few(len(y), y.shape[1], groups if counts.min() < 2 else None)
            training = training.merged(self.max_inputs)
        problem = Problem(
            training,
            scaling,
            self._prior_tril(training, scaling),
            None if length_scale is None else self._door(length_scale / scaling.x_scale),
        )
        warn_if_identical(training)
        if aligned:
            mean, covariance, report, jitter = self._fit_empirical(problem)
        else:
            job = self._mean_job(training)
            mean, mean_report = mean_consistent_with_repeats(training, *job, *fit_together([job]))
            covariance, report, jitter = self._fit_likelihood(problem, training.residual(mean))
            report = report.after(mean_report, "search of the mean")
        return Fitted(self._assemble(self._core_class(mean, covariance), scaling), report, jitter)

    @abstractmethod
    def _fit_empirical(self, problem: Problem) -> tuple[LatentGP, Any, FitReport, float]:
        """Mean, and covariance module from the empirical covariances of aligned data."""

    @abstractmethod
    def _fit_likelihood(self, problem: Problem, residual: Tensor) -> tuple[Any, FitReport, float]:
        """Covariance module by maximum likelihood of the residuals (rows, d) from the mean."""

    def _works_on_empirical(self, inputs: Floats, counts: Any, n_outputs: int) -> bool:
        """Decide the objective; ``inputs`` are the distinct ones, with their counts."""
        fewest = int(counts.min())
        if self.objective == "likelihood" and 2 <= fewest <= n_outputs:
            checks.warn(
                f"y has {fewest} demonstrations at an input but {n_outputs} outputs: the likelihood then takes for "
                f"certain what was only not seen to vary. {n_outputs + 1} or more demonstrations determine the "
                "covariance; objective='auto' shrinks it.",
                DataRankWarning,
            )
        if self.objective == "likelihood" or (self.objective == "auto" and fewest < 2):
            return False
        if fewest < 2:
            i = int(np.argmin(counts))
            raise ValueError(
                f"objective={self.objective!r} needs >= 2 demonstrations at each input, got 1 at X = "
                f"{inputs[i].tolist()} ({int((counts < 2).sum())} of {len(inputs)} inputs have one row). "
                "Align the demonstrations, record more, or use objective='likelihood'."
            )
        if fewest <= n_outputs:
            checks.warn(
                f"y has {fewest} demonstrations at an input but {n_outputs} outputs: that empirical covariance "
                f"is singular, and is shrunk towards the pooled covariance. {n_outputs + 1} or more "
                "demonstrations determine it.",
                DataRankWarning,
            )
        return True

    def _prior_tril(self, training: TrainingSet, scaling: Standardization) -> Tensor:
        if self.prior is None:
            return default_prior_tril(training.y)
        if isinstance(self.prior, str):  # "paper": the entries of the factor are in the units of y
            return torch.diag(1.0 / self._door(scaling.y_scale))
        prior = standardized_prior(self.prior, _in_units(training, scaling), scaling.y_scale)
        return safe_cholesky(self._door(prior), name="prior")

    def _mean_job(self, training: TrainingSet) -> tuple[Observations, EvidenceSearch]:
        """Means at the inputs, weighted by their counts, and the search for their hyperparameters."""
        weights = training.counts / training.counts.mean()
        observations = Observations(training.inputs, training.means().mT.contiguous(), weights)
        return observations, self._search(observations, _LONGEST_MEAN)

    def _search(
        self,
        observations: Observations,
        longest: float,
        length_scale: Tensor | None = None,
        noise_scale: Tensor | None = None,
    ) -> EvidenceSearch:
        shortest = resolved_length_scale(observations.inputs)
        if noise_scale is not None and not bool((noise_scale > 0).any()):
            # Interpolated: longer than where inputs come closest, and the process swings between the others.
            shortest = min(0.5, max(1e-6, _SHORTEST * spacing(observations.inputs, 0.1)))
        limits = self.max_inputs, self.n_restarts, max(100, self.max_iter)
        return EvidenceSearch(self.kernel, (shortest, longest), length_scale, noise_scale, *limits)

    def _latent_values(self, problem: Problem, start: Tensor, amplitude: Tensor) -> LatentValues:
        """Latent values at the inputs from where a likelihood is trained, ``start`` at one or at all of them.

        Length scales that are not given are a fifth of the range of the inputs, and less beside a hole.
        """
        inputs, length_scale = problem.training.inputs, problem.length_scale
        n_inputs, n_features = inputs.shape
        if length_scale is None:
            length_scale = inputs.new_full((n_features,), min(0.2, longest_covariance(inputs)) * n_features**0.5)
        values, trained = start.expand(n_inputs, -1).mT.contiguous(), not self.latent_prior
        return LatentValues(
            inputs, values, amplitude, length_scale[None], kernel=self.kernel, train_hyperparameters=trained
        )

    def _check_memory(self, n_distinct: int, n_features: int, n_outputs: int) -> None:
        n_inputs = min(n_distinct, self.max_inputs)
        n_processes = self._n_processes(n_outputs)
        require_much(
            8.0 * n_inputs**2 * n_processes * 4,
            what=f"max_inputs={self.max_inputs} lets {n_inputs} distinct inputs into kernel matrices of "
            f"{n_processes} processes, which",
            remedy=f"Lower {self._costly}.",
        )

    def _n_processes(self, n_outputs: int) -> int:
        """Processes of the mean and the covariance, at most."""
        return (n_outputs + 1) ** 2


def _in_units(training: TrainingSet, scaling: Standardization) -> Floats:
    """Distinct inputs in the units of X."""
    return scaling.x_shift + scaling.x_scale * training.inputs.cpu().numpy()


def longest_covariance(inputs: Tensor) -> float:
    """Longest length scale of a covariance, in ranges of the inputs (n, e); a hole among them is longer."""
    if inputs.shape[1] == 1:
        hole = float(inputs[:, 0].sort().values.diff().max())
        if hole > max(_HOLE, _SPACINGS * spacing(inputs)):
            return min(_LONGEST_COVARIANCE, hole / _IN_HOLE)
    return _LONGEST_COVARIANCE


def residual_tril(residual: Tensor) -> Tensor:
    """Factor of the covariance of all residuals, where the training of a likelihood starts."""
    floor = 1e-6 * torch.eye(residual.shape[1]).to(residual)
    return scale_tril_from_root(torch.cat([residual.mT / len(residual) ** 0.5, floor], dim=1))


def warn_if_stretched(amplitude: Tensor, targets: Tensor, *, given: bool) -> None:
    """Warn where a length scale that the user gave is too long for what changes over the inputs."""
    if given and bool((amplitude > _STRETCHED * targets.square().mean(1).sqrt().clamp_min(1e-12)).any()):
        checks.warn(
            "length_scale is so long that the covariance follows the data only as the difference of large numbers: "
            "beside the data it will overshoot the prior. Give a shorter one, or None to learn it."
        )


def mean_consistent_with_repeats(
    training: TrainingSet, observations: Observations, search: EvidenceSearch, found: Found
) -> tuple[LatentGP, FitReport]:
    """The processes that the evidence found; or ones through the means, where rows that repeat inputs contradict them.

    The evidence sees the mean at each input, not how far the rows there differ. With few inputs, or jumps between them,
    it may take for noise what all demonstrations agree on. A process that could follow the means only by swinging far
    beyond them between the inputs is not taken, with a warning.
    """
    mean, _ = condition(observations, found.hyperparameters, search.kernel, basis=found.basis)
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
    swings = again.hyperparameters.amplitude > _STRETCHED * observations.targets.square().mean(1).sqrt()
    swings &= again.hyperparameters.length_scale.amin(1) < 1.0
    if bool(swings[wrong].any()):
        checks.warn(
            "y has means at the inputs that differ by more than its scatter there, between inputs too near to each "
            "other for a smooth mean to follow: it does not. Make such rows of X equal, which pools them.",
            DataRankWarning,
        )
        return mean, found.report
    return condition(observations, again.hyperparameters, search.kernel, basis=again.basis)[0], again.report


def _contradicted(
    training: TrainingSet, residual: Float[Tensor, "d n"]
) -> tuple[Bool[Tensor, " d"], Float[Tensor, " d"]]:
    """Whether the means at the inputs are too far from where a process has them; and the smallest error of a mean.

    Together, by the F test of lack of fit; or at one input, by Student's t.
    """
    counts, squares = training.counts, training.squares()
    degrees = counts - 1.0
    pooled = squares.sum(0) / degrees.sum()
    local = torch.maximum(squares / degrees[:, None], _LEAST_SPREAD**2 * pooled)
    squared, n_inputs = residual.mT.square() * counts[:, None], len(counts)
    limit = min(float(fdtri(n_inputs, float(degrees.sum()), 1.0 - _LEVEL)), _CLEAR**2)
    together = squared.mean(0) > limit * pooled + _UNRESOLVED
    each = squared.new_tensor(stdtrit(degrees.cpu().numpy(), 0.5 * _LEVEL / n_inputs))
    alone = squared > each.square()[:, None] * local + _UNRESOLVED
    # The error is of rows that are counted as in the evidence, by their mean.
    return together | alone.any(0), (local.amin(0) / counts.mean()).sqrt()
