"""Fit of the recommended model, by turns of its mean and its covariance: one page, from top to bottom.

Outputs y at input x are, in standardized units,

    y = mu(x) + C w,    w_i = exp(l_i(x) / 2) e_i + sum over j < i of phi_ij(x) e_j,    e ~ N(0, I),      (*)

with C the pooled factor of the noise, and mu_i, l_i and phi_ij Gaussian processes whose values are integrated out: the
modified Cholesky decomposition of a covariance that depends on x (Pourahmadi, 1999). L is the factor of w's covariance.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models.heteroscedastic.covariance import CovarianceSearch, LatentCovariance, fit_covariance
from torch_pbd.models.heteroscedastic.log_variance import Squares, on_stretched_inputs, stretched
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
from torch_pbd.models.heteroscedastic.search import Families, Search, SearchOptions
from torch_pbd.models.training import TrainingSet, pooled_tril
from torch_pbd.optim import Progress

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
    n_demos: int
    """Demonstrations, where rows are known to be of some; else 1."""

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
    to_try: Sequence[Families],
    options: SearchOptions,
    *,
    n_turns: int = 3,
    begin: Callable[[], MeanStart] | None = None,
) -> HeteroscedasticFit:
    """Mean under the noise learned so far, then covariance of the residuals from it, ``n_turns`` times.

    Parameters
    ----------
    training : TrainingSet
    group : Tensor of shape (rows,), or None
        Demonstration of each row. What a turn leaves of each, whitened, shows how far its samples are correlated, which
        the next turn takes into account.
    to_try : sequence of one or two Families
        The second ones, on more inducing inputs, are to go on with where the first do not resolve a length scale with
        room to spare: in the next turn, and in one more after the last.
    options : SearchOptions
    n_turns : int, default=3
    begin : callable, default=None
        Looks for another mean, :func:`mean_start`, where the first one does not follow the data.
    """
    families, larger = to_try[0], to_try[1] if len(to_try) > 1 else None
    n_demos = 1 if group is None else int(group.max()) + 1
    at = _State(training, group, n_demos, families, options, larger, training, _start_tril(training))
    # Share of the rows that count before the correlation of a demonstration's samples is known.
    part = 1.0 if group is None else min(1.0, _FIRST_SAMPLES * n_demos / len(group))
    evidences: list[float] = []
    started, turn = time.perf_counter(), 0
    while turn < n_turns:
        options.slack = _SLACK if turn < n_turns - 1 else 1.0
        # mu given C and L, by generalized least squares.
        mean = at.fit_mean(begin if turn == 0 else None)
        # Residuals r = y - mu, and the share 1 - h of a degree of freedom that fitting mu has left of each.
        residual, share = _residual(at.training, mean, _noise_tril(at.training.inputs, at.pooled, at.covariance))
        # C C' = sum of r r' / sum of (1 - h), once: what changes later is L's.
        at.pooled = at.pooled if turn else _pooled_tril(residual, share)
        # w = inv(C) r of each row; at each input their scatter S, the sum of w w', and its degrees of freedom.
        normal = _solve(at.pooled, residual)
        scatter, degrees = _scatter(at.training, normal, share, part if turn == 0 else 1.0)
        noise = at.noise_correlation(at.training, squares=True)
        if turn == 1:
            at.stretch_ends(normal, noise)
        # l and phi given S, whose likelihood is that of a Wishart distribution.
        fitted = at.training
        at.covariance, evidence = fit_covariance(
            at.search, fitted.inputs, scatter, degrees, noise, at.covariance, cautious=turn == 0
        )
        evidences.append(evidence)
        if options.callback is not None:
            options.callback(Progress(len(evidences), -evidence, time.perf_counter() - started))
        if at.refine(mean):
            n_turns = max(n_turns, turn + 2)
        if turn < n_turns - 1:
            at.correlate(normal)
        turn += 1
    assert at.covariance is not None
    kept = mean, at.covariance, at.pooled, at.correlation
    return HeteroscedasticFit(*kept, tuple(evidences), fitted, residual, n_demos)


@dataclass
class _State:
    """State that one turn leaves to the next."""

    training: TrainingSet
    group: Tensor | None
    n_demos: int
    families: Families
    options: SearchOptions
    larger: Families | None
    rows: TrainingSet
    """Rows of the mean."""
    pooled: Tensor
    covariance: LatentCovariance | None = None
    correlation: DemonstrationCorrelation | None = None

    def __post_init__(self) -> None:
        self.mean_search = Search(self.families.mean, self.training.y.shape[1], self.options)
        self._begin_covariance(self.families.log_variance)

    def _begin_covariance(self, log_variance: ProcessFamily) -> None:
        """Begin the searches of the covariance anew, on processes of a family."""
        self.families = self.families._replace(log_variance=log_variance)
        self.search = CovarianceSearch(self.families, self.training.y.shape[1], self.options)

    def fit_mean(self, begin: Callable[[], MeanStart] | None) -> LatentMean:
        """Mean under the noise so far; or from another beginning, where this one does not follow the data."""
        mean = self._mean()
        start = None if begin is None or _follows(self.training, self.group, mean, self.pooled) else begin()
        if start is None or not start.improves(mean, self.pooled):
            return mean
        self.mean_search, self.pooled, self.rows = start.search, start.noise_tril, start.rows
        return self._mean()

    def _mean(self) -> LatentMean:
        rows = self.rows
        noise = self.noise_correlation(rows, squares=False)
        whitener = None if noise is None else noise.whitener
        tril = _noise_tril(rows.inputs, self.pooled, self.covariance)
        return fit_mean(self.mean_search, rows.inputs, rows.means(), rows.counts, tril, whitener)

    def noise_correlation(self, rows: TrainingSet, *, squares: bool) -> NoiseCorrelation | None:
        """Correlation of the means, or the mean ``squares``, of rows at different inputs; None where there is none."""
        if self.group is None or self.correlation is None or not self.correlation.matters:
            return None
        return self.correlation.at_inputs(rows, self.group, squares=squares)

    def stretch_ends(self, normal: Tensor, noise: NoiseCorrelation | None) -> None:
        """Stretch the ends where the covariance collapses; and begin its searches anew if what the first turn took for
        independent is not, or has other features: that is no place to start from.
        """
        before = self.families.log_variance
        squares = _squares_within(self.training, normal, noise)
        after = stretched(before, self.training.inputs, squares, self.options)
        if after is not before or noise is not None:
            self.covariance = None
            self._begin_covariance(after)

    def refine(self, mean: LatentMean) -> bool:
        """Go on with more inducing inputs where these do not resolve what was found; whether there is need to."""
        if self.larger is None or self.covariance is None:
            return False
        coarse_mean = not self.mean_search.held and not mean.processes.resolved
        if coarse_mean:
            self.mean_search = Search(self.larger.mean, self.training.y.shape[1], self.options)
        coarse = not (self.covariance.log_variances.resolved and self.covariance.rows.resolved)
        if coarse:
            stretch = self.families.log_variance.stretch
            self._begin_covariance(on_stretched_inputs(self.larger.log_variance, self.training.inputs, stretch))
        self.larger = None if coarse or coarse_mean else self.larger
        return coarse or coarse_mean

    def correlate(self, normal: Tensor) -> None:
        """How far samples of a demonstration repeat each other, by e = inv(L) w."""
        if self.group is None or self.covariance is None:
            return
        whitened = _whiten(self.training, normal, self.covariance)
        self.correlation = demonstration_correlation(self.training.x, whitened, self.group)
        if self.correlation.matters:
            # So many inputs that each holds about a row of each demonstration, and enough rows for a covariance by
            # themselves, which takes three more than outputs.
            n_rows = max(self.n_demos, self.training.y.shape[1] + 3)
            self.training = self.training.merged(max(8, len(self.training.x) // n_rows))
            self.rows = self.rows.merged(MOST_INPUTS) if self.mean_search.held else self.training


def _follows(training: TrainingSet, group: Tensor | None, mean: LatentMean, pooled: Tensor) -> bool:
    """Whether residuals of a mean are the noise that it was fitted under: not far less, no signal, and not all of y."""
    residual, _ = _residual(training, mean, pooled.expand(len(training.inputs), -1, -1))
    whitened = _solve(pooled, residual)
    less = whitened.square().mean(0) < _MUCH_LESS
    # By Schwarz's criterion: of 20 inputs once in 30 times by chance, of 500, which tell more, once in 3,000.
    wrong = is_signal(whitened, training, group, LAGS * math.log(len(training.inputs))) & ~less
    # The noise was estimated from neighbours, unless rows repeat inputs.
    if training.counts.mean() < 2.0 or not training.repeats_inputs:
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
    expected = expected[training.index] if training.repeats_inputs else mean.expected_at_rows(training.x)
    half = torch.linalg.solve_triangular(tril, error, upper=False)
    leverage = torch.linalg.solve_triangular(tril, half.mT, upper=False).diagonal(dim1=-2, dim2=-1)
    return training.y - expected, (1.0 - leverage).clamp(_LEAST_SHARE, 1.0)[training.index]


def _scatter(training: TrainingSet, normal: Tensor, share: Tensor, part: float) -> tuple[Tensor, Tensor]:
    """Scatter (n, d, d) and degrees of freedom (d, n) at each input, of a part of the rows."""
    root = training.scatter_root(normal)
    return part * (root @ root.mT), part * training.sums(share).mT


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


def _squares_within(training: TrainingSet, normal: Tensor, noise: NoiseCorrelation | None) -> Squares:
    """Squares of each output around its mean at each input, which an error of the mean does not change; around zero at
    inputs of one row.
    """
    counts = training.counts
    means = torch.where(counts[:, None] > 1.0, training.sums(normal) / counts[:, None], 0.0)
    squares = training.sums((normal - means[training.index]).square())
    degrees = torch.where(counts > 1.0, counts - 1.0, counts).expand(normal.shape[1], -1)
    return Squares(squares.mT, degrees, noise)
