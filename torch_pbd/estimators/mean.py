"""The mean of CD and WP, held against what repeated rows say of it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from scipy.special import fdtri, stdtrit
from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.gp import EvidenceSearch, LatentGP, Observations, condition, fit_together
from torch_pbd.gp.search import Found
from torch_pbd.models.training import TrainingSet
from torch_pbd.optim import FitReport

_LEVEL = 1e-4  # of the tests: how often a mean that is right is taken for wrong
_CLEAR = 5.0  # standard errors of the means, however few rows tell them: of twice two the test would allow for 100
_LEAST_SPREAD = 0.03  # of the pooled one: how small that at an input is believed to be
_STRETCHED = 10.0  # an amplitude of so many times the means; through means that a process follows it is up to 2
_UNRESOLVED = 1e-10  # squared, of standardized outputs: what a smooth process may be off by in any case
_SHARE, _LEAST_NOISE = 0.1, 1e-6  # of the smallest error of a mean, and of the outputs' deviation


def mean_consistent_with_repeats(
    training: TrainingSet, observations: Observations, search: EvidenceSearch, found: Found
) -> tuple[LatentGP, FitReport]:
    """The processes that the evidence found; or ones through the means, where rows that repeat inputs contradict them.

    The evidence sees the mean at each input, not how far the rows there differ. With few inputs, or jumps between them,
    it may take for noise what all demonstrations agree on.

    Warns
    -----
    DataRankWarning
        If the means can be followed by a process only that swings far beyond them between the inputs: it is not taken.
    """
    mean, _ = condition(observations, found.hyperparameters, search.kernel, basis=found.basis)
    if int(training.counts.min()) < 2 or not torch.equal(training.inputs[training.index], training.x):
        return mean, found.report
    spread = _Spread(training)
    with torch.no_grad():
        wrong = spread.contradicts(observations.targets - mean(training.inputs).mT)
    if not bool(wrong.any()):
        return mean, found.report
    learned = found.hyperparameters.amplitude * found.hyperparameters.noise_ratio.sqrt()
    noise_scale = torch.where(wrong, _SHARE * spread.least_error(), learned).clamp_min(_LEAST_NOISE)
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


class _Spread:
    """How far rows that repeat an input differ, (n, d), and what of it the mean at that input may be off by."""

    def __init__(self, training: TrainingSet) -> None:
        counts, means = training.counts, training.means()
        squares = torch.zeros_like(means)
        squares.index_add_(0, training.index, (training.y - means[training.index]).square())
        self._counts, self._degrees = counts, counts - 1.0
        self._pooled = squares.sum(0) / self._degrees.sum()
        local = squares / self._degrees[:, None]
        self._local = torch.maximum(local, _LEAST_SPREAD**2 * self._pooled)

    def least_error(self) -> Float[Tensor, " d"]:
        """Smallest standard error of a mean, of rows that are counted as in the evidence."""
        return (self._local.amin(0) / self._counts.mean()).sqrt()

    def contradicts(self, residual: Float[Tensor, "d n"]) -> Bool[Tensor, " d"]:
        """Whether the means at the inputs are too far from where a process has them.

        Together, by the F test of lack of fit; or at one input, by Student's t.
        """
        squared = residual.mT.square() * self._counts[:, None]
        n_inputs, degrees = len(squared), float(self._degrees.sum())
        limit = min(float(fdtri(n_inputs, degrees, 1.0 - _LEVEL)), _CLEAR**2)
        together = squared.mean(0) > limit * self._pooled + _UNRESOLVED
        each = squared.new_tensor(stdtrit(self._degrees.cpu().numpy(), 0.5 * _LEVEL / n_inputs))
        alone = squared > each.square()[:, None] * self._local + _UNRESOLVED
        return together | alone.any(0)
