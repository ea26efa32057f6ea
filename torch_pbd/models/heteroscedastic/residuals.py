"""What residuals tell of the fit: a mean that does not follow the data, and rows that repeat each other."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.models.training import TrainingSet

LAGS = 3
"""Correlations between neighbours that tell a signal."""

# To tell: a chi-squared number of three degrees of freedom is above it once in 10^6 times. Residuals whitened by a
# covariance of many outputs and few rows are so more often.
NOT_WHITE = 30.7
# What residuals of K demonstrations have in common, of their variance, that is no chance: the mean square of means of
# K would be four times what it should be. Smooth demonstrations have few independent places along the input.
_MOST_COMMON, _COMMON = 0.5, 3.0
# A number of one degree of freedom that is above it once in 10^4 times; the level of the test of smoothness, which
# noise that is far louder in places exceeds by far.
_ALIKE, _LEVEL = 15.1, 1e-5
# Correlation of neighbours that is strong, and that of strangers, relative to it, where a mean would explain it.
_STRONG, _OF_STRANGERS = 0.5, 0.5
_SMOOTH = 0.2  # of the variance of third differences of independent means
_INDEPENDENT = 0.433  # independent ones among n third differences of white noise: 20^2 / (20^2 + 2 (15^2 + 6^2 + 1))
_CONSTANT = 1e-20  # variance of an output that does not vary


def is_signal(
    whitened: Float[Tensor, "rows d"], training: TrainingSet, group: Int64[Tensor, " rows"] | None, least: float
) -> Bool[Tensor, " d"]:
    """Whether residuals of unit variance have something in common along the inputs: not white (a test's statistic
    is above ``least``), and of all rows there.

    Rows of one demonstration may be alike; what tells are those of others at an input, and at the next.
    """
    place = training.inputs[:, 0].argsort().argsort()[training.index]
    both = torch.cat([whitened, torch.ones_like(whitened[:, :1])], dim=1)
    total = both.new_zeros(len(training.inputs), both.shape[1]).index_add_(0, place, both)
    value = total[:, :-1] / total[:, -1:].sqrt()
    # A bounded score: a burst has few large residuals, but all of them are alike.
    value = value / (value.abs() + value.abs().median(0).values).clamp_min(1e-300)
    value = value - value.mean(0)
    coloured = sum(_correlation(value[lag:], value[: len(value) - lag])[1] for lag in range(1, LAGS + 1)) > least
    if group is None:
        n_demos, alike = float(training.counts.mean()), total.square().sum(0) - both.square().sum(0)
    else:
        n_demos = int(group.max()) + 1
        each = both.new_zeros(n_demos * len(total), both.shape[1]).index_add_(0, group * len(total) + place, both)
        each = each.reshape(n_demos, *total.shape)
        alike = total.square().sum(0) - each.square().sum((0, 1))
        alike = alike + 2.0 * ((total[1:] * total[:-1]).sum(0) - (each[:, 1:] * each[:, :-1]).sum((0, 1)))
    common = alike[:-1] / whitened.square().mean(0).clamp_min(1e-300)
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
    strangers, _ = _correlation(by_input[:-1], by_input[1:])
    following = (alike > _STRONG) & (significance > _ALIKE) & (strangers < _OF_STRANGERS * alike)
    return bool((following | _too_smooth(training)).any())


def _correlation(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Of pairs of residuals, and the chi-squared number that it is if they are independent, whatever their variance."""
    products = first * second
    total = products.sum(0)
    size = (first.square().sum(0) * second.square().sum(0)).sqrt().clamp_min(1e-300)
    return total / size, total.square() / products.square().sum(0).clamp_min(1e-300)


def _too_smooth(training: TrainingSet) -> Bool[Tensor, " d"]:
    """Third differences of means at the inputs over what the rows' deviations there allow for: a signal only adds."""
    order = training.inputs[:, 0].argsort()
    counts, means = training.counts[:, None], training.means()
    squares = torch.zeros_like(means).index_add_(0, training.index, (training.y - means[training.index]).square())
    variance = (squares / counts / (counts - 1.0).clamp_min(1.0))[order]
    expected = (variance[:-3] + 9.0 * variance[1:-2] + 9.0 * variance[2:-1] + variance[3:]).mean(0)
    ratio = means[order].diff(n=3, dim=0).square().mean(0) / expected.clamp_min(_CONSTANT)
    half = torch.full_like(ratio, 0.5 * _INDEPENDENT * max(len(means) - 3, 0))
    chance = torch.special.gammainc(half, half * ratio)
    repeated = torch.equal(training.inputs[training.index], training.x)
    return (chance < _LEVEL) & (ratio < _SMOOTH) & (expected > _CONSTANT) & repeated & (counts.min() > 1.0)
