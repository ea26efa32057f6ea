"""Signals in residuals: a mean that does not follow the data, rows that repeat each other, and how far those of a
demonstration do.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torch_pbd.checks import ROUNDING
from torch_pbd.linalg import safe_cholesky, triangular_inverse
from torch_pbd.models.heteroscedastic.regression import NoiseCorrelation, bidiagonal
from torch_pbd.models.training import TrainingSet

LAGS = 3
"""Correlations between neighbours that show a signal."""

NOT_WHITE = 30.7
"""A chi-squared number of three degrees of freedom is above it once in 10^6 times, to warn. Residuals whitened by a
covariance of many outputs and few rows are so more often."""

# What residuals of K demonstrations have in common, of their variance, that is no chance: the mean square of means of
# K would be four times what it should be. Smooth demonstrations have few independent places along the input.
_MOST_COMMON, _COMMON = 0.5, 3.0
# A number of one degree of freedom that is above it once in 10^4 times; the level of the test of smoothness, which
# noise that is far louder in places exceeds by far.
_ALIKE, _LEVEL = 15.1, 1e-5
# Correlation of rows that follow each other that is strong, and of those beside each other along the inputs, relative
# to it, where a mean would explain it.
_STRONG, _OF_NEIGHBOURS = 0.5, 0.5
_SMOOTH = 0.2  # of the variance of third differences of independent means
_SHARE_OF_THIRD = 0.433  # independent ones among third differences of white noise: 20^2 / (20^2 + 2 (15^2 + 6^2 + 1))
_CONSTANT = 1e-20  # variance of an output that does not vary
_LEAST = 1e-300  # a divisor that is zero gives zero and not NaN

# Differences below this share of an output's largest value are rounding, as of other units. So many others, all of them
# multiples of the least to within so much of it, are no chance: once in 10^15. Two states of a gripper are too few.
_SAME, _FEWEST_STEPS, _OFF_STEP = ROUNDING, 15, 0.05

_N_BINS = 50  # bins of the distance between samples, up to the range of the inputs
_MAX_SAMPLES = 400  # most samples used of one demonstration; longer ones are thinned
_MAX_PAIRS = 100_000  # most pairs of samples compared at once, to bound memory
# Samples that count at least for half an independent one are taken for independent: so little correlation
# cannot be known from none.
_INDEPENDENT = 0.5
_SHORTEST, _LONGEST, _HALVINGS = 1e-4, 1e2, 60  # decays, in ranges of the inputs, and bisections down to rounding


def is_signal(
    whitened: Float[Tensor, "rows d"], training: TrainingSet, group: Int64[Tensor, " rows"] | None, least: float
) -> Bool[Tensor, " d"]:
    """Outputs whose residuals of unit variance have something in common along the inputs: they are not white (the
    statistic of a test is above ``least``), and so are all rows there.

    Rows of one demonstration may be alike: a signal is what those of others at an input, and at the next, share too.
    """
    place = training.inputs[:, 0].argsort().argsort()[training.index]
    both = torch.cat([whitened, torch.ones_like(whitened[:, :1])], dim=1)
    total = both.new_zeros(len(training.inputs), both.shape[1]).index_add_(0, place, both)
    value = total[:, :-1] / total[:, -1:].sqrt()
    # A bounded score: a burst has few large residuals, but all of them are alike.
    value = value / (value.abs() + value.abs().median(0).values).clamp_min(_LEAST)
    value = value - value.mean(0)
    coloured = sum(_correlation(value[lag:], value[: len(value) - lag])[1] for lag in range(1, LAGS + 1)) > least
    # Products of rows of different demonstrations: the square of their sum, less the squares of each one's.
    if group is None:
        n_demos, alike = float(training.counts.mean()), total.square().sum(0) - both.square().sum(0)
    else:
        n_demos = int(group.max()) + 1
        each = both.new_zeros(n_demos * len(total), both.shape[1]).index_add_(0, group * len(total) + place, both)
        each = each.reshape(n_demos, *total.shape)
        alike = total.square().sum(0) - each.square().sum((0, 1))
        alike = alike + 2.0 * ((total[1:] * total[:-1]).sum(0) - (each[:, 1:] * each[:, :-1]).sum((0, 1)))
    common = alike[:-1] / whitened.square().mean(0).clamp_min(_LEAST)
    return coloured & ((alike[-1] <= 0) | (common > alike[-1] * min(_MOST_COMMON, _COMMON / max(n_demos - 1.0, 1.0))))


def are_copies(whitened: Float[Tensor, "rows d"], training: TrainingSet, order: Int64[Tensor, " rows"]) -> bool:
    """Whether rows that are taken for independent repeat each other along the inputs.

    By those that follow each other in the ``order`` they were given in, where those next to each other along the inputs
    are less alike; or where inputs repeat, in any order, by their means, which of independent rows were not so smooth.
    """
    x, value = training.x[order], whitened[order]
    step = (x[1:] - x[:-1]).norm(dim=1)
    near = (step > 0) & (step <= 2.0 * step[step > 0].median())
    by_input = value[x[:, 0].argsort(stable=True)]
    alike, significance = _correlation(value[:-1][near], value[1:][near])
    neighbours, _ = _correlation(by_input[:-1], by_input[1:])
    following = (alike > _STRONG) & (significance > _ALIKE) & (neighbours < _OF_NEIGHBOURS * alike)
    return bool((following | _too_smooth(training)).any())


def _correlation(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Correlation of pairs of residuals, and the chi-squared number that it is of independent ones of any variance."""
    products = first * second
    total = products.sum(0)
    size = (first.square().sum(0) * second.square().sum(0)).sqrt().clamp_min(_LEAST)
    return total / size, total.square() / products.square().sum(0).clamp_min(_LEAST)


def _too_smooth(training: TrainingSet) -> Bool[Tensor, " d"]:
    """Outputs whose means at the inputs have third differences far below what the rows' deviations there allow for.

    A signal only adds to them.
    """
    order = training.inputs[:, 0].argsort()
    counts, means = training.counts[:, None], training.means
    variance = (training.squares / counts / (counts - 1.0).clamp_min(1.0))[order]
    expected = (variance[:-3] + 9.0 * variance[1:-2] + 9.0 * variance[2:-1] + variance[3:]).mean(0)
    ratio = means[order].diff(n=3, dim=0).square().mean(0) / expected.clamp_min(_CONSTANT)
    half = torch.full_like(ratio, 0.5 * _SHARE_OF_THIRD * max(len(means) - 3, 0))
    chance = torch.special.gammainc(half, half * ratio)
    smooth = (chance < _LEVEL) & (ratio < _SMOOTH) & (expected > _CONSTANT)
    return smooth & training.repeats_inputs & (counts.min() > 1.0)


def quantum(y: Float[Tensor, "rows d"]) -> Float[Tensor, " d"]:
    """Step of which the values of each output are multiples, as encoders and pixels give them; zero if of none."""
    steps = []
    for values in y.mT:
        difference = values.unique().diff()
        difference = difference[difference > _SAME * values.abs().max()]
        step = float(difference.min()) if len(difference) >= _FEWEST_STEPS else 0.0
        multiple = difference / step
        steps.append(step if bool(((multiple - multiple.round()).abs() < _OFF_STEP).all()) else 0.0)
    return torch.tensor(steps).to(y)


@dataclass(frozen=True)
class DemonstrationCorrelation:
    """Correlation of the whitened residuals of one demonstration, ``exp(-distance / (2 * decay))``.

    Their squares, which the covariance is learned from, have its square. The demonstrations of a person are smoother
    than this kernel says. It has their integral, so it counts the same number of independent samples, but
    its spectrum falls slowly, and so keeps a model from taking what is smoother than noise for signal.
    """

    decay: Float[Tensor, " d"]
    """Distance over which the correlation of squared residuals falls by e, of standardized inputs; 0 if none does."""
    share: Float[Tensor, " d"]
    """Independent samples that a sample of each output counts for."""
    group: Int64[Tensor, " rows"]
    """Demonstration of each row."""

    def at_inputs(self, rows: TrainingSet, *, squares: bool) -> NoiseCorrelation:
        """Correlation of the means, or the mean ``squares``, of rows at their inputs."""
        inputs, counts, group = rows.inputs, rows.counts, self.group
        # Rows of one demonstration at one input are copies: a diagonal entry is the number of rows that count for one.
        n_demos, n_inputs = int(group.max()) + 1, len(inputs)
        occurrences = torch.bincount(group * n_inputs + rows.index, minlength=n_demos * n_inputs)
        occurrences = occurrences.reshape(n_demos, n_inputs).to(inputs)
        shared = occurrences.mT @ occurrences / (counts[:, None] * counts).sqrt()
        distance = torch.cdist(inputs, inputs, compute_mode="donot_use_mm_for_euclid_dist")
        decay = self.decay[:, None, None].clamp_min(_LEAST)
        correlation = shared * torch.exp(-distance / (decay if squares else 2.0 * decay))
        matrix = torch.where(self.decay[:, None, None] > 0, correlation, torch.eye(len(inputs)).to(inputs))
        factor = safe_cholesky(matrix, name="the correlation of the demonstrations")
        return NoiseCorrelation(bidiagonal(triangular_inverse(factor)), matrix.diagonal(dim1=1, dim2=2))


def demonstration_correlation(
    x: Float[Tensor, "rows e"], whitened: Float[Tensor, "rows d"], group: Int64[Tensor, " rows"]
) -> DemonstrationCorrelation | None:
    """Correlation along demonstrations, estimated from whitened residuals; None if of no output samples are correlated.

    The square of the autocorrelation at a distance is estimated without bias by products over pairs of
    different demonstrations, up to the distance where it first is not positive; the decay is that of the
    exponential with the same sum over all pairs of samples.
    """
    limit = math.sqrt(x.shape[1])
    scaled = whitened / whitened.square().mean(0).clamp_min(_LEAST).sqrt()
    chosen = _chosen_rows(x, group)
    if not chosen:
        return None
    # Those of fewer samples are filled up with some that are nowhere.
    places = pad_sequence([x[rows] for rows in chosen], batch_first=True, padding_value=math.nan)
    values = pad_sequence([scaled[rows] for rows in chosen], batch_first=True)
    together = max(1, _MAX_PAIRS // places.shape[1] ** 2)
    parts = zip(places.split(together), values.split(together), strict=True)
    products, pairs = map(torch.cat, zip(*(_products_by_distance(*part, limit) for part in parts), strict=True))
    total, n_chosen = pairs.sum(0), sum(map(len, chosen))
    sum_of_squares = (_squared_autocorrelation(products, pairs) * total[:, None]).sum(0)
    # Of n samples all pairs but those of a sample with itself; were some left out, there are as many more of each.
    share = 1.0 / (1.0 + 2.0 * sum_of_squares / n_chosen * len(x) / n_chosen)
    correlated = share <= _INDEPENDENT
    if not bool(correlated.any()):
        return None
    centre = (torch.arange(_N_BINS).to(x) + 0.5) * limit / _N_BINS
    decay = _decay_of(sum_of_squares, centre, total)
    return DemonstrationCorrelation(torch.where(correlated, decay, 0.0), torch.where(correlated, share, 1.0), group)


def _chosen_rows(x: Tensor, group: Tensor) -> list[Int64[Tensor, " t"]]:
    """Rows of each demonstration that has several, along the first input."""
    order = x[:, 0].argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    demos = [rows for rows in order.split(torch.bincount(group).tolist()) if len(rows) > 1]
    return [rows[:: math.ceil(len(rows) / _MAX_SAMPLES)] for rows in demos]


def _products_by_distance(
    x: Float[Tensor, "g t e"], values: Float[Tensor, "g t d"], limit: float
) -> tuple[Float[Tensor, "g k d"], Float[Tensor, "g k"]]:
    """Sums of the products of pairs of samples of each of g demonstrations, and the numbers of pairs, by distance."""
    n_demos, n_outputs = len(x), values.shape[-1]
    i, j = torch.triu_indices(x.shape[1], x.shape[1], offset=1, device=x.device)
    distance = (x[:, i] - x[:, j]).norm(dim=-1)
    edges = limit * torch.arange(1, _N_BINS).to(x) / _N_BINS + 1e-9
    # The last bin is of those that are too far apart.
    number = torch.where(distance <= limit, torch.bucketize(distance, edges), _N_BINS)
    number = (number + (_N_BINS + 1) * torch.arange(n_demos, device=x.device)[:, None]).flatten()
    size = n_demos * (_N_BINS + 1)
    products = x.new_zeros(size, n_outputs).index_add_(0, number, (values[:, i] * values[:, j]).flatten(0, 1))
    pairs = torch.bincount(number, minlength=size).to(x)
    return products.reshape(n_demos, -1, n_outputs)[:, :-1], pairs.reshape(n_demos, -1)[:, :-1]


def _squared_autocorrelation(products: Float[Tensor, "g k d"], pairs: Float[Tensor, "g k"]) -> Float[Tensor, "k d"]:
    """Squared autocorrelation in each bin of distance; zero from where it first is not positive.

    Means over ordered pairs of different demonstrations, (sum a)^2 - sum a^2, have no bias: their errors are
    independent.
    """
    own = products / pairs.clamp_min(1.0).unsqueeze(-1)
    present = (pairs > 0).sum(0).to(products)[:, None]
    cross = own.sum(0).square() - own.square().sum(0)
    square = (cross / (present * (present - 1.0)).clamp_min(1.0)).clamp(max=1.0)
    ended = ((present > 1) & (square <= 0)).cumsum(0) > 0
    return torch.where((present > 1) & ~ended, square, 0.0)


def _decay_of(target: Float[Tensor, " d"], distance: Float[Tensor, " k"], pairs: Float[Tensor, " k"]) -> Tensor:
    """Decays (d,) whose exponentials sum to the targets over the pairs, by bisection."""
    low, high = torch.full_like(target, _SHORTEST), torch.full_like(target, _LONGEST)
    for _ in range(_HALVINGS):
        middle = (low * high).sqrt()
        too_short = torch.exp(-distance / middle[:, None]) @ pairs < target
        low, high = torch.where(too_short, middle, low), torch.where(too_short, high, middle)
    return (low * high).sqrt()
