"""Fit of the recommended model, by turns of its mean and its covariance: one page, from top to bottom.

Outputs y at input x are, in standardized units,

    y = mu(x) + C w,    w_i = exp(l_i(x) / 2) e_i + sum over j < i of phi_ij(x) e_j,    e ~ N(0, I),      (*)

with C the pooled factor of the noise, and mu_i, l_i and phi_ij Gaussian processes whose values are integrated out: the
modified Cholesky decomposition of a covariance that depends on x (Pourahmadi, 1999). L is the factor of w's covariance.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.gp.inducing import FeatureMap
from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models.heteroscedastic.covariance import CovarianceSearches, LatentCovariance, fit_covariance
from torch_pbd.models.heteroscedastic.mean import MOST_INPUTS, LatentMean, MeanStart, fit_mean
from torch_pbd.models.heteroscedastic.processes import ProcessFamily
from torch_pbd.models.heteroscedastic.residuals import (
    LAGS,
    NOT_WHITE,
    DemonstrationCorrelation,
    NoiseCorrelation,
    demonstration_correlation,
    is_signal,
)
from torch_pbd.models.heteroscedastic.search import Search, SearchOptions
from torch_pbd.models.training import TrainingSet, pooled_tril

# Prior medians of length scale (in ranges of the input) and amplitude, and prior deviation of the constant. Means
# are of outputs with unit variance, log variances and coefficients of residuals with a pooled unit covariance.
_MEAN = (0.3, 1.2, 0.0)
_LOG_VARIANCE = (0.5, 1.0, 2.0)
_COEFFICIENT = (0.5, 0.3, 1.0)

# Rows at an input whose mean is all their own still count for this share of a degree of freedom, or nothing there
# would be known of the variance.
_LEAST_SHARE = 0.1
# Of the searches' tolerance, in all turns but the last: their hyperparameters are only where the next ones start.
_SLACK = 10.0
_ROWS_TOGETHER = 8  # neighbours whose deviations are the noise of the first mean: few, so that their trend is small
# Samples of a demonstration that count before its correlation is known: a cautious first turn, as all of them, taken
# for independent, would show their smoothness as signal.
_FIRST_SAMPLES = 10.0
# Of y's standard deviation: an output that is constant, or a copy of another, has this deviation of its own.
_LEAST_DEVIATION = 1e-6
# Of an output's deviation, as long as the mean is fitted: with exact copies among the outputs the equations would
# else have digits for their difference alone.
_LEAST_OWN = 1e-4
# Residuals of a first mean that are wrong: of less than this share of the variance taken for noise, or of more than
# that share of y's variance, which is a mean of nothing and doubtful in few rows too.
_MUCH_LESS, _NEARLY_ALL = 0.25, 0.9
_WORTH_A_WARNING = 0.03  # of y's variance: what a smooth mean misses of a corner is less


@dataclass(frozen=True)
class Families:
    """Families of the processes of the mean, the log variances and the coefficients."""

    mean: ProcessFamily
    log_variance: ProcessFamily
    coefficients: ProcessFamily

    @classmethod
    def build(
        cls,
        mean_features: FeatureMap,
        covariance_features: FeatureMap,
        length_scale: Float[Tensor, " e"] | None = None,
        *,
        shared: bool = False,
    ) -> "Families":
        """Families of the recommended model on these features; ``length_scale`` holds the covariance's."""
        return cls(
            ProcessFamily(mean_features, *_MEAN, shared=shared),
            ProcessFamily(covariance_features, *_LOG_VARIANCE, length_scale, shared),
            ProcessFamily(covariance_features, *_COEFFICIENT, length_scale),
        )

    def searches(self, training: TrainingSet, options: SearchOptions) -> tuple[Search, CovarianceSearches]:
        """Searches of the mean's and the covariance's hyperparameters that have not begun."""
        (n_outputs, n_features), family = (training.y.shape[1], training.x.shape[1]), self.coefficients
        log_variance = Search(self.log_variance, n_outputs, n_features, options)
        rows = [Search(family, 1, n_features, options) for _ in range(1, n_outputs)]
        return Search(self.mean, n_outputs, n_features, options), CovarianceSearches(log_variance, rows, family)


@dataclass(frozen=True)
class HeteroscedasticFit:
    """Posterior of mean and covariance of standardized outputs."""

    mean: LatentMean
    covariance: LatentCovariance
    """Posterior of L, the factor of the residuals' covariance once they are multiplied by the inverse of C."""
    pooled_tril: Float[Tensor, "d d"]
    """C."""
    correlation: DemonstrationCorrelation | None
    log_evidence: tuple[float, ...]
    """Log evidence of the covariance's processes at the end of each turn, in nats."""
    training: TrainingSet
    residual: Float[Tensor, "rows d"]

    def whitened(self) -> Float[Tensor, "rows d"]:
        """Residuals of unit covariance."""
        return _whiten(self.training, _solve(self.pooled_tril, self.residual), self.covariance)

    def missed(self, group: Int64[Tensor, " rows"] | None) -> Bool[Tensor, " d"]:
        """Outputs whose residuals are a signal that the mean does not follow."""
        # What an output has beyond those before it: of outputs that vary together nothing is left but rounding.
        matters = self.pooled_tril.diagonal().square() > _WORTH_A_WARNING
        return matters & is_signal(self.whitened(), self.training, group, NOT_WHITE)


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

    Parameters
    ----------
    training : TrainingSet
    group : Tensor of shape (rows,), or None
        Demonstration of each row. What a turn leaves of each, whitened, shows how far its samples are correlated, which
        the next turn takes into account.
    families : Families
    options : SearchOptions
    n_turns : int, default=3
    needs_resolution : bool, default=False
        Give the fit up, and return None, at the end of the first turn in which the inducing inputs do not resolve a
        length scale with room to spare, unless they are all the inputs.
    begin : callable, default=None
        Looks for another mean, :func:`mean_start`, where the first one does not follow the data.
    """
    covariance: LatentCovariance | None = None
    correlation: DemonstrationCorrelation | None = None
    pooled, rows = _start_tril(training), training  # rows, of the mean
    mean_search, searches = families.searches(training, options)
    evidences: list[float] = []
    started = time.perf_counter()
    for turn in range(n_turns):
        options.slack = _SLACK if turn < n_turns - 1 else 1.0
        # mu given C and L, by generalized least squares.
        mean = _fit_mean(mean_search, rows, group, pooled, covariance, correlation)
        start = None if turn or begin is None or _follows(training, group, mean, pooled) else begin()
        if start is not None and start.improves(mean, pooled):
            mean_search, pooled, rows = start.search, start.noise_tril, start.rows
            mean = _fit_mean(mean_search, rows, group, pooled, None, None)
        # Residuals r = y - mu, and the share 1 - h of a degree of freedom that fitting mu has left of each.
        residual, share = _residual(training, mean, _noise_tril(training.inputs, pooled, covariance))
        # C C' = sum of r r' / sum of (1 - h), once: what changes later is L's.
        pooled = pooled if turn else _pooled_tril(residual, share)
        # w = inv(C) r of each row; at each input their scatter S, the sum of w w', and its degrees of freedom.
        normal = _solve(pooled, residual)
        scatter, degrees = _scatter(training, normal, share, 1.0 if turn else _first_part(training, group))
        # l and phi given S, whose likelihood is that of a Wishart distribution. What the first turn took for
        # independent is no place to start from where it is not.
        if turn == 1 and correlation is not None and correlation.matters:
            covariance, (_, searches) = None, families.searches(training, options)
        noise = NoiseCorrelation.build(correlation, training.inputs, training.index, group)
        covariance, evidence = fit_covariance(searches, training.inputs, scatter, degrees, noise, covariance)
        if needs_resolution and not (covariance.resolved and (mean_search.held or mean.family.resolved(mean.theta))):
            return None
        evidences.append(evidence)
        options.report(len(evidences), -evidence, time.perf_counter() - started)
        # e = inv(L) w of the samples of a demonstration, and how far they repeat each other.
        if group is not None and turn < n_turns - 1:
            correlation = demonstration_correlation(training.x, _whiten(training, normal, covariance), group)
            if correlation.matters:
                training = training.merged(_n_inputs(training, group))
                rows = rows.merged(MOST_INPUTS) if mean_search.held else training
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
    whitener = NoiseCorrelation.build(correlation, training.inputs, training.index, group).mean_whitener
    tril = _noise_tril(training.inputs, pooled, covariance)
    return fit_mean(search, training.inputs, training.means(), training.counts, tril, whitener)


def _follows(training: TrainingSet, group: Tensor | None, mean: LatentMean, pooled: Tensor) -> bool:
    """Whether residuals of a mean are the noise that it was fitted under: not far less, no signal, and not all of y."""
    residual, _ = _residual(training, mean, pooled.expand(len(training.inputs), -1, -1))
    whitened = _solve(pooled, residual)
    less = whitened.square().mean(0) < _MUCH_LESS
    # By Schwarz's criterion: of 20 inputs once in 30 times by chance, of 500, which tell more, once in 3,000.
    wrong = is_signal(whitened, training, group, LAGS * math.log(len(training.inputs))) & ~less
    # The noise was estimated from neighbours, unless rows repeat inputs.
    if training.counts.mean() < 2.0 or not _repeats_inputs(training):
        wrong = wrong | less | (residual.square().mean(0) > _NEARLY_ALL)
    return not bool(wrong.any())


def _noise_tril(inputs: Tensor, pooled: Tensor, covariance: LatentCovariance | None) -> Tensor:
    """Factor (n, d, d) of the noise C L of a row at each input, with a little that is each output's own."""
    if covariance is None:
        return pooled.expand(len(inputs), -1, -1)
    tril = pooled @ covariance.at(inputs).tril()
    own = (_LEAST_OWN * tril.norm(dim=-1)).clamp_min(_LEAST_DEVIATION)
    return scale_tril_from_root(torch.cat([tril, torch.diag_embed(own)], dim=-1))


def _start_tril(training: TrainingSet) -> Tensor:
    """Factor of the covariance within inputs, or within neighbourhoods where they do not repeat."""
    repeated = 2 * len(training.inputs) <= len(training.x)
    whole = training if repeated else training.merged(max(2, len(training.x) // _ROWS_TOGETHER))
    # A thousandth of y's deviation: noise is never less where the search for the mean begins.
    floor = 1e-3 * torch.eye(training.y.shape[1]).to(training.y)
    return scale_tril_from_root(torch.cat([pooled_tril(whole), floor], dim=1))


def _residual(training: TrainingSet, mean: LatentMean, tril: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals of the rows, and the shares (rows, d) of a degree of freedom that fitting the mean has left.

    With the covariance V of the mean's error and the factor T of the noise the leverage of a row is the diagonal of
    inv(T) V inv(T)': of output i, that of the part of it which the outputs before do not explain.
    """
    expected, error = mean.at(training.inputs)
    expected = expected[training.index] if _repeats_inputs(training) else mean.expected(training.x)
    half = torch.linalg.solve_triangular(tril, error, upper=False)
    leverage = torch.linalg.solve_triangular(tril, half.mT, upper=False).diagonal(dim1=-2, dim2=-1)
    return training.y - expected, (1.0 - leverage).clamp(_LEAST_SHARE, 1.0)[training.index]


def _scatter(training: TrainingSet, normal: Tensor, share: Tensor, part: float) -> tuple[Tensor, Tensor]:
    """Scatter (n, d, d) and degrees of freedom (d, n) at each input, of a part of the rows."""
    root = training.scatter_root(normal)
    degrees = torch.zeros_like(training.means()).index_add_(0, training.index, share)
    return part * (root @ root.mT), part * degrees.mT


def _repeats_inputs(training: TrainingSet) -> bool:
    """Whether rows are at the inputs themselves, which are no centres of neighbourhoods."""
    return torch.equal(training.inputs[training.index], training.x)


def _pooled_tril(residual: Tensor, share: Tensor) -> Tensor:
    """Factor of the residuals' covariance, of their degrees of freedom."""
    floor = _LEAST_DEVIATION * share.sum(0).sqrt() * torch.eye(residual.shape[1]).to(residual)
    return scale_tril_from_root(torch.cat([residual.mT, floor], dim=1)) / share.sum(0).sqrt()


def _solve(tril: Tensor, residual: Tensor) -> Tensor:
    """Residuals (rows, d) multiplied by the inverse of a factor."""
    return torch.linalg.solve_triangular(tril, residual.mT, upper=False).mT


def _whiten(training: TrainingSet, normal: Tensor, covariance: LatentCovariance) -> Tensor:
    """Residuals (rows, d) of unit covariance at each input."""
    tril = covariance.at(training.inputs).tril()[training.index]
    return torch.linalg.solve_triangular(tril, normal.unsqueeze(2), upper=False).squeeze(2)


def _first_part(training: TrainingSet, group: Tensor | None) -> float:
    """Share of the rows that count before the correlation of a demonstration's samples is known."""
    return 1.0 if group is None else min(1.0, _FIRST_SAMPLES * len(group.unique()) / len(group))


def _n_inputs(training: TrainingSet, group: Tensor) -> int:
    """Distinct inputs where demonstrations are correlated: so many that each holds about a row of each demonstration,
    and enough rows for a covariance by themselves, which takes three more than outputs.
    """
    rows = max(len(group.unique()), training.y.shape[1] + 3)
    return max(8, len(training.x) // rows)
