"""Fit of mean and covariance, by turns."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.gp.inducing import FeatureMap
from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models.heteroscedastic.correlation import (
    DemonstrationCorrelation,
    NoiseCorrelation,
    demonstration_correlation,
)
from torch_pbd.models.heteroscedastic.covariance import CovarianceSearches, fit_covariance
from torch_pbd.models.heteroscedastic.latent import LatentCovariance
from torch_pbd.models.heteroscedastic.mean import LatentMean, fit_mean
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.residuals import LAGS, NOT_WHITE, is_signal
from torch_pbd.models.heteroscedastic.search import Search, SearchOptions
from torch_pbd.models.heteroscedastic.start import MOST_INPUTS, MeanStart
from torch_pbd.models.training import TrainingSet, pooled_tril

# Prior medians of length scale (in ranges of the input) and amplitude, and prior deviation of the constant. Means
# are of outputs with unit variance, log variances and coefficients of residuals with a pooled unit covariance.
_MEAN = (0.3, 1.2, 0.0)
_LOG_VARIANCE = (0.5, 1.0, 2.0)
_COEFFICIENT = (0.5, 0.3, 1.0)

# Rows at an input whose mean is all their own still tell this share of a variance, or nothing would.
_LEAST_SHARE = 0.1
_SLACK = 10.0  # of searches in all turns but the last
_ROWS_TOGETHER = 8  # neighbours whose differences tell the noise that the first mean is fitted under
_FIRST_SAMPLES = 10.0  # of a demonstration: what counts of it before its correlation is known
# Of y's standard deviation: an output that is constant, or a copy of another, has this deviation of its own.
_LEAST_DEVIATION = 1e-6
_MUCH_LESS = 0.25  # of the variance that was taken for noise
_NEARLY_ALL = 0.9  # of y's variance: a mean of nothing is doubtful, in few rows too
_WORTH_TELLING = 0.03  # of y's variance: what no smooth mean follows of a corner leaves less
_LEAST_OWN = 1e-4  # of an output's deviation, as long as the mean is fitted


@dataclass(frozen=True)
class Families:
    """Of the processes of the mean, the log variances and the coefficients."""

    mean: ProcessFamily
    log_variance: ProcessFamily
    coefficients: ProcessFamily

    @classmethod
    def of(
        cls,
        of_mean: FeatureMap,
        of_covariance: FeatureMap,
        length_scale: Float[Tensor, " e"] | None = None,
        *,
        shared: bool = False,
    ) -> "Families":
        """Those that the recommended model has, on these features; ``length_scale`` holds the covariance's."""
        return cls(
            ProcessFamily(of_mean, *_MEAN, shared=shared),
            ProcessFamily(of_covariance, *_LOG_VARIANCE, length_scale, shared),
            ProcessFamily(of_covariance, *_COEFFICIENT, length_scale),
        )


@dataclass(frozen=True)
class HeteroscedasticFit:
    """Posterior of mean and covariance of standardized outputs."""

    mean: LatentMean
    covariance: LatentCovariance
    """Of residuals multiplied by the inverse of ``pooled_tril``."""
    pooled_tril: Float[Tensor, "d d"]
    correlation: DemonstrationCorrelation | None
    log_evidence: tuple[float, ...]
    """Of the covariance, at the end of each turn, in nats."""
    training: TrainingSet
    residual: Float[Tensor, "rows d"]

    def whitened(self) -> Float[Tensor, "rows d"]:
        """Residuals of unit covariance."""
        return _whitened(self.training, _solved(self.pooled_tril, self.residual), self.covariance)

    def missed(self, group: Int64[Tensor, " rows"] | None) -> Bool[Tensor, " d"]:
        """Outputs whose residuals are a signal that the mean does not follow."""
        # What an output has beyond those before it: of outputs that vary together nothing is left but rounding.
        worth_telling = self.pooled_tril.diagonal().square() > _WORTH_TELLING
        return worth_telling & is_signal(self.whitened(), self.training, group, NOT_WHITE)


def fit_heteroscedastic(
    training: TrainingSet,
    group: Int64[Tensor, " rows"] | None,
    families: Families,
    options: SearchOptions,
    *,
    n_turns: int = 3,
    needs_resolution: bool = False,
    begin: Callable[[], MeanStart] | None = None,
) -> HeteroscedasticFit | None:
    """Mean under the noise learned so far, then covariance of the residuals from it, ``n_turns`` times.

    ``group`` tells the demonstrations apart. What the first turns leave of each, whitened, tells how far
    its samples are correlated, which the later ones take into account.

    Where the first mean does not follow the data, and the evidence for what ``begin`` finds (:func:`mean_start`) is
    clearly higher, the mean is from there.

    With ``needs_resolution`` the fit is given up, and None, at the end of the first turn in which the inducing inputs
    do not resolve a length scale with room to spare, unless they are all the inputs.
    """
    covariance: LatentCovariance | None = None
    correlation: DemonstrationCorrelation | None = None
    evidences: list[float] = []
    pooled, of_mean = _start_tril(training), training
    size = (training.y.shape[1], training.x.shape[1])
    mean_search, both = Search(families.mean, *size, options), (families.log_variance, families.coefficients)
    searches = CovarianceSearches.of(both, *size, options)
    started = time.perf_counter()
    for turn in range(n_turns):
        options.slack = _SLACK if turn < n_turns - 1 else 1.0
        mean = _fit_mean(mean_search, of_mean, group, pooled, covariance, correlation)
        if (
            begin is not None
            and turn == 0
            and not _follows(training, group, mean, pooled)
            and (start := begin()).improves(mean, pooled)
        ):
            mean_search, pooled, of_mean = start.search, start.noise_tril, start.rows
            mean = _fit_mean(mean_search, of_mean, group, pooled, None, None)
        residual, share = _residual(training, mean, _tril_at(training.inputs, pooled, covariance))
        pooled = pooled if turn else _pooled_tril(residual, share)
        normal, scatter, degrees = _scatter(training, residual, share, pooled)
        part = 1.0 if turn else _first_part(training, group)
        # What the first turn took for independent is no place to start from where it is not.
        if turn == 1 and correlation is not None and correlation.matters:
            covariance, searches = None, CovarianceSearches.of(both, *size, options)
        covariance, evidence = fit_covariance(
            searches,
            training.inputs,
            part * scatter,
            part * degrees,
            NoiseCorrelation.of(correlation, training.inputs, training.index, group),
            covariance,
        )
        if needs_resolution and not (covariance.resolved and (mean_search.held or mean.family.resolved(mean.theta))):
            return None
        evidences.append(evidence)
        options.report(len(evidences), -evidence, time.perf_counter() - started)
        if group is not None and turn < n_turns - 1:
            correlation = demonstration_correlation(training.x, _whitened(training, normal, covariance), group)
            if correlation.matters:
                training = training.merged(_n_inputs(training, group))
                of_mean = of_mean.merged(MOST_INPUTS) if mean_search.held else training
    assert covariance is not None
    return HeteroscedasticFit(mean, covariance, pooled, correlation, tuple(evidences), training, residual)


def _fit_mean(
    search: Search,
    training: TrainingSet,
    group: Tensor | None,
    pooled: Tensor,
    covariance: LatentCovariance | None,
    correlation: DemonstrationCorrelation | None,
) -> LatentMean:
    """Mean under the noise so far."""
    whitener = NoiseCorrelation.of(correlation, training.inputs, training.index, group).of_means
    tril = _tril_at(training.inputs, pooled, covariance)
    return fit_mean(search, training.inputs, training.means(), training.counts, tril, whitener)


def _follows(training: TrainingSet, group: Tensor | None, mean: LatentMean, pooled: Tensor) -> bool:
    """Whether residuals of a mean are the noise that it was fitted under: not far less, no signal, and not all of y."""
    residual, _ = _residual(training, mean, pooled.expand(len(training.inputs), -1, -1))
    whitened = _solved(pooled, residual)
    less = whitened.square().mean(0) < _MUCH_LESS
    # By Schwarz's criterion: of 20 inputs once in 30 times by chance, of 500, which tell more, once in 3,000.
    wrong = is_signal(whitened, training, group, LAGS * math.log(len(training.inputs))) & ~less
    # The noise was estimated from neighbours, unless rows repeat inputs.
    if training.counts.mean() < 2.0 or not torch.equal(training.inputs[training.index], training.x):
        wrong = wrong | less | (residual.square().mean(0) > _NEARLY_ALL)
    return not bool(wrong.any())


def _tril_at(inputs: Tensor, pooled: Tensor, covariance: LatentCovariance | None) -> Tensor:
    """Factor of the noise of the means. A little is each output's own: of exact copies the equations would else
    have digits for their difference alone.
    """
    if covariance is None:
        return pooled.expand(len(inputs), -1, -1)
    tril = pooled @ covariance.at(inputs).tril()
    own = (_LEAST_OWN * tril.norm(dim=-1)).clamp_min(_LEAST_DEVIATION)
    return scale_tril_from_root(torch.cat([tril, torch.diag_embed(own)], dim=-1))


def _start_tril(training: TrainingSet) -> Tensor:
    """Factor of the covariance within inputs, or within neighbourhoods where they do not repeat."""
    repeated = 2 * len(training.inputs) <= len(training.x)
    whole = training if repeated else training.merged(max(2, len(training.x) // _ROWS_TOGETHER))
    floor = 1e-3 * torch.eye(training.y.shape[1]).to(training.y)
    return scale_tril_from_root(torch.cat([pooled_tril(whole), floor], dim=1))


def _scatter(training: TrainingSet, residual: Tensor, share: Tensor, pooled: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals of pooled unit covariance (rows, d); their scatter and degrees of freedom at each input."""
    normal = _solved(pooled, residual)
    root = training.scatter_root(normal)
    degrees = torch.zeros_like(training.means()).index_add_(0, training.index, share)
    return normal, root @ root.mT, degrees.mT


def _solved(tril: Tensor, residual: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(tril, residual.mT, upper=False).mT


def _whitened(training: TrainingSet, normal: Tensor, covariance: LatentCovariance) -> Tensor:
    """Residuals (rows, d) of unit covariance at each input."""
    tril = covariance.at(training.inputs).tril()[training.index]
    return torch.linalg.solve_triangular(tril, normal.unsqueeze(2), upper=False).squeeze(2)


def _first_part(training: TrainingSet, group: Tensor | None) -> float:
    """Share of the rows that count before it is known how far those of a demonstration are correlated."""
    if group is None:
        return 1.0
    return min(1.0, _FIRST_SAMPLES * len(group.unique()) / len(group))


def _residual(training: TrainingSet, mean: LatentMean, tril: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals of the rows, and the shares (rows, d) of a degree of freedom that fitting the mean has left.

    Of output i the share is that of its part which the outputs before it do not tell.
    """
    expected, error = mean.at(training.inputs)
    if torch.equal(training.inputs[training.index], training.x):
        expected = expected[training.index]
    else:  # the inputs are the centres of neighbourhoods
        expected = mean.expected(training.x)
    half = torch.linalg.solve_triangular(tril, error, upper=False)
    leverage = torch.linalg.solve_triangular(tril, half.mT, upper=False).diagonal(dim1=-2, dim2=-1)
    return training.y - expected, (1.0 - leverage).clamp(_LEAST_SHARE, 1.0)[training.index]


def _pooled_tril(residual: Tensor, share: Tensor) -> Tensor:
    floor = _LEAST_DEVIATION * share.sum(0).sqrt() * torch.eye(residual.shape[1]).to(residual)
    return scale_tril_from_root(torch.cat([residual.mT, floor], dim=1)) / share.sum(0).sqrt()


def _n_inputs(training: TrainingSet, group: Tensor) -> int:
    """Inputs to tell apart where demonstrations are correlated: so many that each holds about a row of each
    demonstration, and enough to tell a covariance by themselves.
    """
    rows = max(len(group.unique()), training.y.shape[1] + 3)
    return max(8, len(training.x) // rows)
