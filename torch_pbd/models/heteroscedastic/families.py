"""The model's families of processes, and the features that they rest on: as many as needed, dense where needed.

Movements that start or end at one point have deviations that collapse there. One process has one length scale, and that
of a deviation which is even for nineteen twentieths of a movement and falls by thirty in the last is neither the one
nor the other. Where the evidence is clearly higher so the inputs of the covariance's processes are stretched at an end.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.files.memory import require_much
from torch_pbd.gp.inducing import FeatureMap, FixedFeatures, inducing_inputs
from torch_pbd.gp.observations import spacing
from torch_pbd.models.heteroscedastic.covariance import CovarianceSearches
from torch_pbd.models.heteroscedastic.log_variance import Squares, log_variance_evidence
from torch_pbd.models.heteroscedastic.processes import ProcessFamily, Search, SearchOptions
from torch_pbd.models.heteroscedastic.residuals import NoiseCorrelation
from torch_pbd.models.training import TrainingSet

# Prior medians of length scale (in ranges of the input) and amplitude, and prior deviation of the constant. Means
# are of outputs with unit variance, log variances and coefficients of residuals with a pooled unit covariance.
_MEAN = (0.3, 1.2, 0.0)
_LOG_VARIANCE = (0.5, 1.0, 2.0)
_COEFFICIENT = (0.5, 0.3, 1.0)

# An end gets as much length as the whole range has, most of it within the first of these shares of the range (a spacing
# of the inputs at least) or the second: a process of a usual length scale is then as free there as elsewhere in all.
_LENGTH, _WIDTHS = 1.0, (0.02, 0.06)
# An end is tried where deviations in its first hundredth are below this share of those from 5 to 15 % of the range, of
# some output: a process of a usual length scale follows what falls less.
_FALLS = 1.0 / 3.0
# Nats: an end that falls by thirty gains some fifty from six demonstrations. One of nine recorded sets gained up to
# eleven, and lost a tenth of a nat a step of what was left out.
_CLEARLY = 20.0

# By default, for one column of X and for several, and where these do not resolve what is learned. At most of all
# outputs together, for the mean and for the covariance, as a fit takes the cube of these; but a dozen for each output.
_OF_ONE, _OF_SEVERAL, _MOST, _TOGETHER, _FEWEST = 48, 128, 128, (800, 400), 12


@dataclass(frozen=True)
class Families:
    """Families of the processes of the mean, the log variances and the coefficients."""

    mean: ProcessFamily
    log_variance: ProcessFamily
    coefficients: ProcessFamily

    @classmethod
    def candidates(
        cls,
        inputs: Float[Tensor, "n e"],
        n_distinct: int,
        sizes: list[tuple[int, int]],
        *,
        kernel: str,
        period: Float[Tensor, " e"] | None,
        length_scale: Float[Tensor, " e"] | None,
        shared: bool,
    ) -> list["Families"]:
        """Families of the recommended model on as many inducing inputs as :func:`inducing_sizes` says.

        With as many as the ``n_distinct`` inputs that there were they are exact. ``length_scale`` holds the
        covariance's; means share one and log variances share one where it is ``shared``.
        """
        found = []
        for pair in sizes:
            inducing = [inducing_inputs(inputs, size) for size in pair]
            of_mean, of_covariance = (FeatureMap(z, kernel, period, len(z) == n_distinct) for z in inducing)
            mean = ProcessFamily(of_mean, *_MEAN, shared=shared)
            log_variance = ProcessFamily(of_covariance, *_LOG_VARIANCE, length_scale, shared)
            found.append(cls(mean, log_variance, ProcessFamily(of_covariance, *_COEFFICIENT, length_scale)))
        return found

    def covariance_searches(self, n_outputs: int, n_features: int, options: SearchOptions) -> CovarianceSearches:
        """Searches of the covariance's hyperparameters that have not begun."""
        log_variance = Search(self.log_variance, n_outputs, n_features, options)
        rows = [Search(self.coefficients, 1, n_features, options) for _ in range(1, n_outputs)]
        return CovarianceSearches(log_variance, rows, self.coefficients)

    def with_covariance(self, features: FeatureMap) -> "Families":
        """Families whose covariance rests on other features."""
        log_variance = replace(self.log_variance, features=features)
        return Families(self.mean, log_variance, replace(self.coefficients, features=features))

    def refined(self, larger: "Families", inputs: Float[Tensor, "n e"]) -> "Families":
        """Families whose covariance rests on the inducing inputs of larger ones, stretched as it is."""
        features, stretch = larger.log_variance.features, self.log_variance.features.stretch
        return self.with_covariance(features if stretch is None else _stretch(features, inputs, stretch))

    def stretched(
        self, training: TrainingSet, normal: Float[Tensor, "rows d"], noise: NoiseCorrelation, options: SearchOptions
    ) -> "Families":
        """Families with the ends stretched at which the evidence for the log variances of residuals is higher so.

        Each end at which deviations fall is tried by itself, and two together, by the best points of the searches' grid
        and, where these say so, by what searches find.
        """
        plain, inputs = self.log_variance.features, training.inputs
        if inputs.shape[1] > 1 or plain.period is not None or self.log_variance.fixed_length_scale is not None:
            return self
        squares = _within(training, normal, noise)
        falling = [end for end in (0, 1) if _falls(squares, inputs[:, 0], end)]
        if not falling:
            return self
        # From the best point of the grid, to a tenth of a nat: what is asked is whether twenty are gained.
        options = replace(options, n_restarts=0, tol=max(options.tol, 0.1))

        def evidence(features: FeatureMap, *, at_once: bool) -> float:
            family = replace(self.log_variance, features=features)
            of_theta = log_variance_evidence(family, FixedFeatures(features, inputs), squares)
            search = Search(family, len(squares.total), 1, options)
            return float((search.best_of_grid if at_once else search.maximum)(of_theta, squares.total))

        result, stretch = plain, inputs.new_tensor([[0.0, 1.0], [0.0, 1.0]])
        on_grid, highest = evidence(plain, at_once=True), None
        widths = [max(width, width / _WIDTHS[0] * spacing(inputs)) for width in _WIDTHS]
        for ends in ([0], [1], [0, 1]) if len(falling) > 1 else [falling]:
            stretches = [_with_ends(stretch, ends, width) for width in widths]
            tried = [_stretch(plain, inputs, each) for each in stretches]
            found = [evidence(each, at_once=True) for each in tried]
            best = max(range(len(found)), key=found.__getitem__)
            if found[best] < on_grid + _CLEARLY:
                continue
            highest = evidence(result, at_once=False) if highest is None else highest
            now = evidence(tried[best], at_once=False)
            if now > highest + _CLEARLY:
                on_grid, highest, result, stretch = found[best], now, tried[best], stretches[best]
        return self if result is plain else self.with_covariance(result)


def _falls(squares: Squares, x: Float[Tensor, " n"], end: int) -> bool:
    """Whether deviations of an output fall at the start (0) or the goal (1) of the range."""
    far = (x - x.min() if end == 0 else x.max() - x) / (x.max() - x.min())
    outer, inner = far <= 0.01, (far >= 0.05) & (far <= 0.15)
    variances = [squares.total[:, part].sum(1) / squares.degrees[:, part].sum(1) for part in (outer, inner)]
    return bool((variances[0] < _FALLS**2 * variances[1]).any())  # of no inputs there the quotient is not a number


def _with_ends(stretch: Tensor, ends: list[int], width: float) -> Tensor:
    row = stretch.new_tensor([_LENGTH, width])
    return torch.stack([row if end in ends else own for end, own in enumerate(stretch)])


def _stretch(features: FeatureMap, inputs: Float[Tensor, "n e"], stretch: Float[Tensor, "2 2"]) -> FeatureMap:
    """Features with as many inducing inputs, evenly over the stretched range."""
    features = replace(features, stretch=stretch)
    if features.exact:
        return features
    chosen = replace(features, inducing=inputs).farthest_first[: len(features.inducing)]
    return replace(features, inducing=inputs[chosen.sort().values])


def _within(training: TrainingSet, normal: Tensor, noise: NoiseCorrelation) -> Squares:
    """Squares of each output around its mean at each input, which an error of the mean does not change; around zero at
    inputs of one row.
    """
    counts = training.counts
    means = torch.where(counts[:, None] > 1.0, training.sums(normal) / counts[:, None], 0.0)
    squares = training.sums((normal - means[training.index]).square())
    degrees = torch.where(counts > 1.0, counts - 1.0, counts).expand(normal.shape[1], -1)
    return Squares(squares.mT, degrees, noise)


def inducing_sizes(n_inducing: int | None, n_features: int, n_outputs: int) -> list[tuple[int, int]]:
    """Inducing inputs of the mean's processes and of the covariance's, to be tried one after another."""
    if n_inducing is not None:
        return [(n_inducing, n_inducing)]
    most_mean, most_covariance = (max(_FEWEST, most // n_outputs) for most in _TOGETHER)
    few = _OF_ONE if n_features == 1 else _OF_SEVERAL
    return list(dict.fromkeys((min(size, most_mean), min(size, most_covariance)) for size in (few, _MOST)))


def check_memory(n_inducing: int | None, max_inputs: int, shape: tuple[int, int, int]) -> None:
    """Check that a fit of ``shape``, distinct inputs, their columns and outputs, has the memory that it needs.

    Measured: each output's features for the differences that start a search take the most, and then all outputs'
    together.

    Raises
    ------
    ValueError
        If it has not.
    """
    n_distinct, n_features, n_outputs = shape
    n_inputs = min(n_distinct, max_inputs)
    size = min(n_inputs, max(max(pair) for pair in inducing_sizes(n_inducing, n_features, n_outputs)))
    searched = 4 * (n_features + 1) * (n_features + 2) * n_outputs * size * (n_inputs + size)
    require_much(
        8.0 * (searched + 24 * (n_outputs * size) ** 2),
        what=f"max_inputs={max_inputs} with n_inducing={n_inducing} lets {n_inputs} distinct "
        f"inputs and {size} inducing ones into the fit, which",
        remedy="Lower them, n_inducing first.",
    )
