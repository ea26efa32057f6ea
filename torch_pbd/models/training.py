"""Training rows by distinct input, and the statistics of them to which models are fitted."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torch_pbd.gp.observations import neighbourhoods, spacing, sum_by
from torch_pbd.linalg import scale_tril_from_root

_NEAR = 0.1  # of the spacing of the inputs, or of the mean one
_CHUNK = 1024  # inputs that a mean is evaluated at together: its correlations take 8 kB for each, of 1000 inputs


@dataclass(frozen=True)
class TrainingSet:
    """N rows at n distinct inputs, in standardized units.

    ``inputs[index]`` are the inputs of the rows: exactly, or after :meth:`merged` their neighbourhoods'
    centres.
    """

    x: Float[Tensor, "rows e"]
    y: Float[Tensor, "rows d"]
    inputs: Float[Tensor, "n e"]
    index: Int64[Tensor, " rows"]

    @cached_property
    def counts(self) -> Float[Tensor, " n"]:
        """Rows at each distinct input."""
        return torch.bincount(self.index, minlength=len(self.inputs)).to(self.y)

    @cached_property
    def repeats_inputs(self) -> bool:
        """Whether rows are at the inputs themselves, which are no centres of neighbourhoods."""
        return torch.equal(self.inputs[self.index], self.x)

    def sums(self, values: Float[Tensor, "rows d"]) -> Float[Tensor, "n d"]:
        """Sum at each distinct input of what rows have."""
        return sum_by(values, self.index, len(self.inputs))

    @cached_property
    def means(self) -> Float[Tensor, "n d"]:
        """Mean of y at each distinct input."""
        return self.sums(self.y) / self.counts[:, None]

    @cached_property
    def squares(self) -> Float[Tensor, "n d"]:
        """Sum at each distinct input of the squares of y around its mean there."""
        return self.sums((self.y - self.means[self.index]).square())

    def merged(self, max_inputs: int) -> "TrainingSet":
        """Rows with at most ``max_inputs`` distinct inputs: neighbours are taken together."""
        if len(self.inputs) <= max_inputs:
            return self
        return self._by(neighbourhoods(self.inputs, max_inputs))

    def without_near_inputs(self) -> "TrainingSet":
        """Rows with inputs on a line, each of several rows, taken together where they are far nearer than most: stamps
        in pairs or bursts, which no length scale tells apart, and no stretch of finer ones.
        """
        if self.inputs.shape[1] > 1 or int(self.counts.min()) < 2:
            return self
        place, order = self.inputs[:, 0].sort(stable=True)
        near = _NEAR * max(spacing(self.inputs), float(place[-1] - place[0]) / len(place))
        run = torch.nn.functional.pad((place.diff() >= near).cumsum(0), (1, 0))
        last = torch.bincount(run).cumsum(0) - 1
        # Each run is one input, and of runs that go on for longer every input is one by itself.
        is_long = (place[last] - place[torch.searchsorted(run, run.unique())] >= near)[run]
        runs = (is_long | (run.diff(prepend=run[:1] - 1) > 0)).cumsum(0) - 1
        return self if int(runs[-1]) + 1 == len(place) else self._by(torch.empty_like(order).index_copy(0, order, runs))

    def _by(self, neighbourhood: Int64[Tensor, " n"]) -> "TrainingSet":
        index = neighbourhood[self.index]
        counts = torch.bincount(index).to(self.x)
        return replace(self, inputs=sum_by(self.x, index) / counts[:, None], index=index)

    def residual(self, mean: Callable[[Tensor], Tensor]) -> Float[Tensor, "rows d"]:
        """Residual of y from its mean at each row; ``mean`` maps inputs (m, e) to (m, d).

        It is evaluated for a bounded number of inputs at a time, and where rows repeat an input for that alone.
        """
        repeated = self.repeats_inputs
        at = self.inputs if repeated else self.x
        with torch.no_grad():
            values = torch.cat([mean(chunk) for chunk in at.split(_CHUNK)])
        return self.y - (values[self.index] if repeated else values)

    def scatter_root(self, residual: Float[Tensor, "rows d"]) -> Float[Tensor, "n d r"]:
        """Root of the scatter at each input: ``root @ root.mT`` is the sum of ``w w'`` over its rows.

        The rows of each input are laid side by side, and where they are more than d reduced to d by a QR
        decomposition: no product is formed, and K <= d rows are no special case. Inputs whose numbers of rows lie
        between the same powers of two are treated together, so memory is linear in the rows.
        """
        counts, n_outputs = torch.bincount(self.index, minlength=len(self.inputs)), residual.shape[1]
        rows = residual[self.index.argsort(stable=True)]
        if int(counts.min()) == int(counts.max()):
            return _reduced(rows.reshape(len(counts), -1, n_outputs))
        parts = rows.split(counts.tolist())
        result = residual.new_zeros(len(counts), n_outputs, min(n_outputs, int(counts.max())))
        size = counts.clamp_min(1).log2().ceil()
        for exponent in size.unique():
            members = (size == exponent).nonzero().squeeze(-1)
            # Zeros, which add nothing, fill up those that have fewer rows.
            root = _reduced(pad_sequence([parts[i] for i in members.tolist()], batch_first=True))
            result[members, :, : root.shape[-1]] = root
        return result


def _reduced(rows: Float[Tensor, "n k d"]) -> Float[Tensor, "n d r"]:
    """Root of the scatter of k rows, of no more than d columns."""
    return scale_tril_from_root(rows.mT) if rows.shape[1] > rows.shape[2] else rows.mT


def pooled_tril(training: TrainingSet) -> Float[Tensor, "d d"]:
    """Factor of the covariance of y around its mean at each input, pooled over the inputs.

    Where no input repeats there is nothing to pool: then of the covariance of all of y.
    """
    degrees = len(training.y) - len(training.inputs)
    residual = training.y - training.means[training.index]
    if degrees < 1:
        residual, degrees = training.y - training.y.mean(0), max(1, len(training.y) - 1)
    return scale_tril_from_root(residual.mT) / degrees**0.5


def residual_tril(residual: Tensor) -> Tensor:
    """Factor of the covariance of all residuals, where the training of a likelihood starts."""
    return scale_tril_from_root(residual.mT / len(residual) ** 0.5, 1e-6)


def default_prior_tril(y: Tensor) -> Tensor:
    """Factor of a wide prior: four times the covariance of all of y around its mean."""
    # With a thousandth of the unit matrix outputs that move together, or not at all, have some freedom of their own.
    return 2.0 * scale_tril_from_root((0.999 / (len(y) - 1)) ** 0.5 * (y - y.mean(0)).mT, 0.001**0.5)


def empirical_tril(training: TrainingSet, *, bias_correction: bool = False) -> Float[Tensor, "n d d"]:
    """Factor of the empirical covariance at each distinct input; its divisor is the count less one.

    At an input with no more than d rows the scatter is singular. There it is shrunk towards the pooled
    covariance as by an inverse-Wishart prior of d + 1 degrees of freedom.

    ``bias_correction`` divides column i of each factor that was not shrunk by its expectation for normal data
    (Bartlett), ``sqrt(2 / (K - 1)) * gamma((K - i + 1) / 2) / gamma((K - i) / 2)``, i from 1.
    """
    n_outputs = training.y.shape[1]
    root = training.scatter_root(training.y - training.means[training.index])
    degrees = training.counts - 1.0
    lacking = degrees < n_outputs
    prior_degrees = float(n_outputs + 1)
    if bool(lacking.any()):
        # The prior adds d + 1 times the pooled covariance to the scatter, by roots side by side, and d + 1 degrees.
        prior_root = prior_degrees**0.5 * pooled_tril(training) * lacking[:, None, None]
        root = torch.cat([root, prior_root], dim=-1)
    scale_tril = scale_tril_from_root(root) / (degrees + prior_degrees * lacking).sqrt()[:, None, None]
    if not bias_correction:
        return scale_tril
    # Column i of the factor of the scatter has a mean of that of chi with K - i degrees times that of the true one.
    degrees = degrees.clamp_min(n_outputs)[:, None]
    rest = degrees - torch.arange(n_outputs).to(degrees)
    expected = (torch.lgamma((rest + 1.0) / 2.0) - torch.lgamma(rest / 2.0)).exp() * (2.0 / degrees).sqrt()
    return scale_tril / torch.where(lacking[:, None], 1.0, expected)[:, None, :]


def mean_over_geometric(training: TrainingSet) -> Float[Tensor, "n d"]:
    """Mean of the diagonal entries of an empirical factor over the exponential of their mean logarithm.

    For normal data, of which they are chi; one where the factor was shrunk.
    """
    # Entry i of K rows is chi with 2 h = K - i degrees: its mean is sqrt(2) gamma(h + 1/2) / gamma(h), and that of its
    # logarithm (log(2) + digamma(h)) / 2.
    n_outputs, degrees = training.y.shape[1], training.counts - 1.0
    half = 0.5 * (degrees[:, None] - torch.arange(n_outputs).to(degrees)).clamp_min(1.0)
    ratio = (torch.lgamma(half + 0.5) - torch.lgamma(half) - 0.5 * torch.digamma(half)).exp()
    return torch.where((degrees < n_outputs)[:, None], 1.0, ratio)
