"""Fit of the recommended model, by turns of its mean and its covariance: one page, from top to bottom.

Outputs y at input x are, in standardized units,

    y = mu(x) + C w,    w_i = exp(l_i(x) / 2) e_i + sum over j < i of phi_ij(x) e_j,    e ~ N(0, I),      (*)

with C the pooled factor of the noise, and mu_i, l_i and phi_ij Gaussian processes whose values are integrated out: the
modified Cholesky decomposition of a covariance that depends on x (Pourahmadi, 1999). L is the factor of w's covariance.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models.heteroscedastic.log_variance import squares_within
from torch_pbd.models.heteroscedastic.posterior import LatentCovariance, LatentMean
from torch_pbd.models.heteroscedastic.regression import NoiseCorrelation
from torch_pbd.models.heteroscedastic.residuals import (
    LAGS,
    NOT_WHITE,
    DemonstrationCorrelation,
    demonstration_correlation,
    is_signal,
    quantum,
)
from torch_pbd.models.heteroscedastic.search import Families, Search, SearchOptions, on_stretched_inputs, stretched
from torch_pbd.models.heteroscedastic.steps import MOST_INPUTS, CovarianceSearch, fit_covariance, fit_mean, mean_start
from torch_pbd.models.training import TrainingSet, pooled_tril
from torch_pbd.optim.batch import Progress

_TURNS = 3  # of mean and covariance, unless more inducing inputs are called for
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
_FOLLOWED = 1e-3  # of the deviation of y: farther from copies of one demonstration a mean does not follow it
_WORTH_A_WARNING = 0.03  # share of y's variance missed by the mean that warns; at a corner, a smooth mean misses less


@dataclass
class HeteroscedasticFit:
    """Posterior of mean and covariance of standardized outputs, with the state that one turn leaves to the next."""

    training: TrainingSet
    group: Int64[Tensor, " rows"] | None
    identical: bool
    """Whether rows at an input never vary: their variance is the least, whatever a mean leaves of them."""
    families: Families
    larger: Families | None
    options: SearchOptions
    covariance: LatentCovariance | None = None
    """Posterior of L, the factor of the residuals' covariance once they are multiplied by the inverse of C."""
    correlation: DemonstrationCorrelation | None = None
    log_evidence: list[float] = field(default_factory=list)
    """Log evidence of the covariance's processes at the end of each turn, in nats."""
    mean_rows: TrainingSet = field(init=False)
    pooled_tril: Float[Tensor, "d d"] = field(init=False)
    """C, once there are residuals; before, the factor of the covariance within inputs or neighbourhoods."""
    mean: LatentMean = field(init=False)
    residual: Float[Tensor, "rows d"] = field(init=False)

    def __post_init__(self) -> None:
        self.mean_rows = whole = self.training
        if len(whole.x) < 2 * len(whole.inputs):  # they do not repeat
            whole = whole.merged(max(2, len(whole.x) // _ROWS_TOGETHER))
        # A thousandth of y's deviation: noise is never less where the search for the mean begins.
        self.pooled_tril = scale_tril_from_root(pooled_tril(whole), 1e-3)
        self._n_outputs = self.training.y.shape[1]
        self.n_demos = 1 if self.group is None else int(self.group.max()) + 1
        self._quantum = quantum(self.training.y)
        if self.identical:
            self._quantum.clamp_min_(12.0**0.5 * _LEAST_DEVIATION)
        self._mean_search = Search(self.families.mean, self._n_outputs, self.options)
        self.search = CovarianceSearch(self.families.log_variance, self._n_outputs, self.options)

    def fit_mean(self, anew: TrainingSet | None) -> None:
        """Mean under the noise so far, and residuals; begun again of rows ``anew`` if it does not follow the data."""
        noise = self.noise_correlation(self.mean_rows, squares=False)
        self.mean = fit_mean(self._mean_search, self.mean_rows, self.noise_tril(self.mean_rows.inputs), noise)
        self.residual = self.mean.residual(self.training)
        if anew is None or self._follows():
            return
        if (start := mean_start(anew, self.mean, self.pooled_tril, self.options)) is not None:
            self._mean_search, self.pooled_tril, self.mean_rows = start
            self.fit_mean(None)

    def _follows(self) -> bool:
        """Whether residuals of the first mean are the noise that it was fitted under: not far less, no signal, and not
        all of y.
        """
        training, whitened = self.training, self.normal()
        less = whitened.square().mean(0) < _MUCH_LESS
        # By Schwarz's criterion: of 20 inputs once in 30 times by chance, of 500, which tell more, once in 3,000.
        wrong = is_signal(whitened, training, self.group, LAGS * math.log(len(training.inputs))) & ~less
        # The noise was estimated from neighbours, unless rows repeat inputs.
        if training.counts.mean() < 2.0 or not training.repeats_inputs:
            wrong = wrong | less | (self.residual.square().mean(0) > _NEARLY_ALL)
        return not bool(wrong.any())

    def shares(self) -> Float[Tensor, "rows d"]:
        """Shares of a degree of freedom that fitting the mean has left of each row.

        With the covariance V of the mean's error and the factor T of the noise the leverage of a row is the diagonal of
        inv(T) V inv(T)': of output i, that of the part of it which the outputs before do not explain.
        """
        tril, (_, error) = self.noise_tril(self.training.inputs), self.mean.at(self.training.inputs)
        half = torch.linalg.solve_triangular(tril, error, upper=False)
        leverage = torch.linalg.solve_triangular(tril, half.mT, upper=False).diagonal(dim1=-2, dim2=-1)
        return (1.0 - leverage).clamp(_LEAST_SHARE, 1.0)[self.training.index]

    def noise_tril(self, inputs: Float[Tensor, "n e"]) -> Float[Tensor, "n d d"]:
        """Factor of the noise C L of a row at each input, with a little that is each output's own."""
        if self.covariance is None:
            return self.pooled_tril.expand(len(inputs), -1, -1)
        tril = self.pooled_tril @ self.covariance.at(inputs).tril()
        own = (_LEAST_OWN * tril.norm(dim=-1)).clamp_min(_LEAST_DEVIATION)
        return scale_tril_from_root(torch.cat([tril, torch.diag_embed(own)], dim=-1))

    def noise_correlation(self, rows: TrainingSet, *, squares: bool) -> NoiseCorrelation | None:
        """Correlation of the means, or the mean ``squares``, of rows at different inputs; None where there is none."""
        return None if self.correlation is None else self.correlation.at_inputs(rows, squares=squares)

    def stretch_ends(self, noise: NoiseCorrelation | None) -> None:
        """Stretch the ends where the covariance collapses; and begin its searches anew if what the first turn took for
        independent is not, or has other features: that is no place to start from.
        """
        before = self.search.log_variance.family
        squares = squares_within(self.training, self.normal(), noise)
        after = stretched(before, self.training.inputs, squares, self.options)
        if after is not before or noise is not None:
            self.covariance = None
            self.search = CovarianceSearch(after, self._n_outputs, self.options)

    def refine(self) -> bool:
        """Go on with more inducing inputs where these do not resolve what was found; whether there is need to."""
        if self.larger is None or self.covariance is None:
            return False
        coarse_mean = self._mean_search.held is None and not self.mean.processes.resolved
        if coarse_mean:
            self._mean_search = Search(self.larger.mean, self._n_outputs, self.options)
        coarse = not (self.covariance.log_variances.resolved and self.covariance.rows.resolved)
        if coarse:
            stretch = self.search.log_variance.family.stretch
            family = on_stretched_inputs(self.larger.log_variance, self.training.inputs, stretch)
            self.search = CovarianceSearch(family, self._n_outputs, self.options)
        self.larger = None if coarse or coarse_mean else self.larger
        return coarse or coarse_mean

    def correlate(self) -> None:
        """Estimate the correlation of a demonstration's samples from e = inv(L) w."""
        if self.group is None or self.identical:
            return
        self.correlation = demonstration_correlation(self.training.x, self.whitened(), self.group)
        if self.correlation is not None:
            # So many inputs that each holds about a row of each demonstration, and enough rows for a covariance by
            # themselves, which takes three more than outputs.
            n_rows = max(self.n_demos, self._n_outputs + 3)
            self.training = self.training.merged(max(8, len(self.training.x) // n_rows))
            self.mean_rows = self.training if self._mean_search.held is None else self.mean_rows.merged(MOST_INPUTS)

    def normal(self) -> Float[Tensor, "rows d"]:
        """Residuals multiplied by the inverse of C."""
        return torch.linalg.solve_triangular(self.pooled_tril, self.residual.mT, upper=False).mT

    def above_rounding(self, scatter: Float[Tensor, "n d d"]) -> Float[Tensor, "n d d"]:
        """Scatter at each input with no output's less than that of rounding, q^2 / 12 for each row.

        Where all demonstrations were rounded to one value their variance is not zero, but unknown below this.
        """
        rounding = torch.linalg.solve_triangular(self.pooled_tril, self._quantum.diag() / 12.0**0.5, upper=False)
        # At most the pooled variance, which is one: at a constant speed values are multiples of a step by themselves.
        least = self.training.counts[:, None] * rounding.square().sum(1).clamp_max(1.0)
        return scatter + torch.diag_embed((least - scatter.diagonal(dim1=1, dim2=2)).clamp_min(0.0))

    def whitened(self) -> Float[Tensor, "rows d"]:
        """Residuals of unit covariance at each input."""
        assert self.covariance is not None
        tril = self.covariance.at(self.training.inputs).tril()[self.training.index]
        return torch.linalg.solve_triangular(tril, self.normal().unsqueeze(2), upper=False).squeeze(2)

    def missed(self) -> Bool[Tensor, " d"]:
        """Outputs whose residuals are a signal that the mean does not follow."""
        # What an output has beyond those before it: of outputs that vary together nothing is left but rounding.
        matters = self.pooled_tril.diagonal().square() > _WORTH_A_WARNING
        return matters & is_signal(self.whitened(), self.training, self.group, NOT_WHITE)


@torch.inference_mode()
def fit_heteroscedastic(
    training: TrainingSet,
    group: Int64[Tensor, " rows"] | None,
    to_try: Sequence[Families],
    options: SearchOptions,
    *,
    rows: TrainingSet | None = None,
    identical: bool = False,
) -> HeteroscedasticFit:
    """Mean under the noise learned so far, then covariance of the residuals from it, by turns.

    What a turn leaves of the rows of each demonstration, of which there is a ``group``, shows how far they are
    correlated, which the next turn takes into account. The second of two families, on more inducing inputs, is to go on
    with where the first does not resolve a length scale with room to spare: in the next turn, and in one more after the
    last. Of ``rows``, at all their inputs, the mean begins anew where the first one does not follow the data.
    """
    larger = to_try[1] if len(to_try) > 1 else None
    fit = HeteroscedasticFit(training, group, identical, to_try[0], larger, options)
    # Share of the rows that count before the correlation of a demonstration's samples is known.
    first_part = 1.0 if group is None else min(1.0, _FIRST_SAMPLES * fit.n_demos / len(group))
    given = training
    started, turn, n_turns = time.perf_counter(), 0, _TURNS
    while turn < n_turns:
        options.slack = _SLACK if turn < n_turns - 1 else 1.0
        # mu given C and L, by generalized least squares, and the residuals r = y - mu.
        fit.fit_mean(rows if turn == 0 else None)
        if identical:
            fit.residual.zero_()
        # The share 1 - h of a degree of freedom that fitting mu has left of each.
        training, share = fit.training, fit.shares()
        # C C' = sum of r r' / sum of (1 - h), once: what changes later is L's.
        if turn == 0:
            total = share.sum(0).sqrt()
            fit.pooled_tril = scale_tril_from_root(fit.residual.mT, _LEAST_DEVIATION * total) / total
        # w = inv(C) r of each row; at each input their scatter S, the sum of w w', and its degrees of freedom.
        root, part = training.scatter_root(fit.normal()), first_part if turn == 0 else 1.0
        scatter, degrees = part * fit.above_rounding(root @ root.mT), part * training.sums(share).mT
        noise = fit.noise_correlation(training, squares=True)
        if turn == 1:
            fit.stretch_ends(noise)
        # l and phi given S, whose likelihood is that of a Wishart distribution.
        fit.covariance, evidence = fit_covariance(
            fit.search, training.inputs, scatter, degrees, noise, fit.covariance, cautious=turn == 0
        )
        fit.log_evidence.append(evidence)
        if options.callback is not None:
            options.callback(Progress(turn + 1, -evidence, time.perf_counter() - started))
        if fit.refine():
            n_turns = max(n_turns, turn + 2)
        if turn < n_turns - 1:
            fit.correlate()
        turn += 1
    if identical and bool((fit.mean.residual(fit.training).abs() > _FOLLOWED).any()):
        # What is common to them is no mean that can be learned: what it leaves is all that says how far it errs.
        return fit_heteroscedastic(given, group, to_try, options, rows=rows)
    return fit
