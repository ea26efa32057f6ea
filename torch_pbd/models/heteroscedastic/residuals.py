"""What residuals tell of the fit: a mean that does not follow the data, and rows that repeat each other."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from torch_pbd.models.training import TrainingSet

_LAGS = 3
_NOT_WHITE = 21.1  # 0.9999 quantile of the chi-squared distribution of three degrees of freedom
# What residuals of K demonstrations have in common, of their variance, that is no chance: the mean square of means of
# K would be four times what it should be. Smooth demonstrations have few independent places along the input.
_MOST_COMMON, _COMMON = 0.5, 3.0
# Quantiles of the chi-squared distribution of one degree of freedom, and of a ratio's own: a false alarm in 10,000 fits.
_ALIKE, _LEVEL = 15.1, 1e-4
# Correlation of neighbours that is strong, and that of strangers, relative to it, where a mean would explain it.
_STRONG, _OF_STRANGERS = 0.5, 0.5
_SMOOTH = 0.25  # of the variance of third differences of independent means
_THIRD = (-1.0, 3.0, -3.0, 1.0)
_INDEPENDENT = 0.433  # independent ones among n third differences of white noise: 20^2 / (20^2 + 2 (15^2 + 6^2 + 1))


def is_signal(
    whitened: Float[Tensor, "rows d"], training: TrainingSet, group: Int64[Tensor, " rows"] | None
) -> Bool[Tensor, " d"]:
    """Whether residuals of unit variance have something in common along the inputs: not white, and of all rows there.

    Rows of one demonstration may be alike; what tells are those of others at an input and at the next.
    """
    order = training.inputs[:, 0].argsort()
    place = order.argsort()[training.index]
    counts = training.counts[order][:, None]
    total = torch.zeros_like(training.means()).index_add_(0, place, whitened)
    value = total / counts.sqrt()
    # The square of each sum of products over that of their squares, whatever the variance: chi-squared, of white noise.
    products = [value[lag:] * value[: len(value) - lag] for lag in range(1, _LAGS + 1)]
    share = [each.sum(0).square() / each.square().sum(0).clamp_min(1e-300) for each in products]
    coloured = torch.stack(share).sum(0) > _NOT_WHITE
    if group is None:
        own, own_counts, n_demos = whitened.square().sum(0), counts.sum(), float(counts.mean())
        common, pairs = total.square().sum(0) - own, counts.square().sum() - own_counts
    else:
        n_demos = int(group.max()) + 1
        both = torch.cat([whitened, torch.ones_like(whitened[:, :1])], dim=1)
        each = both.new_zeros(n_demos * len(counts), both.shape[1])
        each = each.index_add_(0, group * len(counts) + place, both).reshape(n_demos, len(counts), -1)
        every = each.sum(0)
        alike = every.square().sum(0) - each.square().sum((0, 1))
        alike = alike + 2.0 * ((every[1:] * every[:-1]).sum(0) - (each[:, 1:] * each[:, :-1]).sum((0, 1)))
        common, pairs = alike[:-1], alike[-1]
    if not bool(pairs > 0):
        return coloured
    variance = whitened.square().mean(0).clamp_min(1e-300)
    return coloured & (common / pairs > variance * min(_MOST_COMMON, _COMMON / max(n_demos - 1.0, 1e-9)))


def are_copies(
    whitened: Float[Tensor, "rows d"], training: TrainingSet, scale: Float[Tensor, "n d"], order: Int64[Tensor, " rows"]
) -> bool:
    """Whether rows that are taken for independent repeat each other along the inputs.

    By the rows that follow each other in the ``order`` they were given in, if those that are as near but of other
    demonstrations are less alike. Or where inputs repeat, in any order, by the means there: were the rows independent
    of deviations ``scale``, they could not be that smooth.
    """
    x, value = training.x[order], whitened[order]
    step = (x[1:] - x[:-1]).norm(dim=1)
    near = (step > 0) & (step <= 2.0 * step[step > 0].median())
    by_input = value[x[:, 0].argsort(stable=True)]
    alike, significance = _correlation(value[:-1][near], value[1:][near])
    strangers, _ = _correlation(by_input[:-1], by_input[1:])
    following = (alike > _STRONG) & (significance > _ALIKE) & (strangers < _OF_STRANGERS * alike)
    return bool((following | _too_smooth(training, scale)).any())


def _correlation(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Of pairs of residuals, and the chi-squared number that it is if they are independent, whatever their variance."""
    products = first * second
    total = products.sum(0)
    size = (first.square().sum(0) * second.square().sum(0)).sqrt().clamp_min(1e-300)
    return total / size, total.square() / products.square().sum(0).clamp_min(1e-300)


def _too_smooth(training: TrainingSet, scale: Float[Tensor, "n d"]) -> Bool[Tensor, " d"]:
    """Third differences of the means at the inputs, over what they would be of independent rows: a signal only adds."""
    order = training.inputs[:, 0].argsort()
    means, variance = training.means()[order], (scale.square() / training.counts[:, None])[order]
    n = max(len(means) - 3, 0)
    parts = [(c * means[j : j + n], c * c * variance[j : j + n]) for j, c in enumerate(_THIRD)]
    difference, expected = (torch.stack(part).sum(0) for part in zip(*parts, strict=True))
    half = 0.5 * _INDEPENDENT * n
    ratio = (difference.square() / expected).mean(0)
    chance = torch.special.gammainc(torch.full_like(ratio, half), half * ratio)
    return (chance < _LEVEL) & (ratio < _SMOOTH) & bool(training.counts.min() > 1)
