"""How much the samples of one demonstration repeat each other, and what that leaves to learn from."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import safe_cholesky

_N_BINS = 50  # of the distance between samples, up to the range of the inputs
_MAX_SAMPLES = 400  # of one demonstration; of longer ones a share
_MAX_PAIRS = 100_000  # of samples that are compared at once: bounds the memory
# Samples that count at least for half an independent one are taken for independent: so little correlation
# cannot be told from none.
_INDEPENDENT = 0.5


@dataclass(frozen=True)
class DemonstrationCorrelation:
    """Correlation of the whitened residuals of one demonstration, ``exp(-distance / (2 * decay))``.

    Their squares, which tell the covariance, have its square. The demonstrations of a person are smoother
    than this kernel says. It has their integral, so it counts the same number of independent samples, but
    its spectrum falls slowly, and so keeps a model from taking what is smoother than noise for signal.
    """

    decay: Float[Tensor, " d"]
    """Distance over which the correlation of squared residuals falls by e, of standardized inputs; 0 if none does."""
    share: Float[Tensor, " d"]
    """Independent samples that a sample of each output counts for."""

    @property
    def matters(self) -> bool:
        """Whether samples of any output are correlated."""
        return bool((self.decay > 0).any())

    def matrix(
        self, inputs: Float[Tensor, "n e"], occurrences: Float[Tensor, "g n"], *, squares: bool
    ) -> Float[Tensor, "d n n"]:
        """Covariance of the means (or mean squares) at n inputs, were they of independent rows of unit variance.

        ``occurrences`` are the rows of each of g demonstrations at each input: those of one demonstration at one
        input are copies, so a diagonal entry is the number of rows that count for one.
        """
        distance = torch.cdist(inputs, inputs, compute_mode="donot_use_mm_for_euclid_dist")
        decay = self.decay[:, None, None].clamp_min(1e-300)
        correlation = torch.exp(-distance / (decay if squares else 2.0 * decay))
        counts = occurrences.sum(0)
        shared = occurrences.mT @ occurrences / (counts[:, None] * counts).sqrt()
        return torch.where(self.decay[:, None, None] > 0, correlation * shared, torch.eye(len(inputs)).to(inputs))


@dataclass(frozen=True)
class NoiseCorrelation:
    """What makes means and mean squares of each output at n inputs independent; None where all are."""

    of_means: Float[Tensor, "d n n"] | None = None
    of_squares: Float[Tensor, "d n n"] | None = None
    copies: Float[Tensor, "d n"] | None = None
    """Rows at each input that count for one."""

    @classmethod
    def of(
        cls,
        correlation: DemonstrationCorrelation | None,
        inputs: Float[Tensor, "n e"],
        index: Int64[Tensor, " rows"],
        group: Int64[Tensor, " rows"] | None,
    ) -> "NoiseCorrelation":
        """Of rows of demonstrations ``group``, at ``inputs[index]``."""
        if group is None or correlation is None or not correlation.matters:
            return cls()
        occurrences = _occurrences(index, group, len(inputs)).to(inputs)
        of_means, of_squares = (correlation.matrix(inputs, occurrences, squares=squares) for squares in (False, True))
        return cls(_whitener(of_means), _whitener(of_squares), of_squares.diagonal(dim1=1, dim2=2))

    def rows(self, index: Tensor) -> "NoiseCorrelation":
        """Those of some of the outputs."""
        return NoiseCorrelation(*(None if part is None else part[index] for part in self._parts()))

    def _parts(self) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        return self.of_means, self.of_squares, self.copies


def _whitener(matrix: Tensor) -> Tensor:
    factor = safe_cholesky(matrix, name="the correlation of the demonstrations")
    return torch.linalg.solve_triangular(factor, torch.eye(factor.shape[-1]).to(factor).expand_as(factor), upper=False)


def _occurrences(index: Tensor, group: Tensor, n_inputs: int) -> Tensor:
    """Rows of each demonstration at each distinct input."""
    names, number = group.unique(return_inverse=True)
    return torch.bincount(number * n_inputs + index, minlength=len(names) * n_inputs).reshape(len(names), n_inputs)


def demonstration_correlation(
    x: Float[Tensor, "rows e"], whitened: Float[Tensor, "rows d"], group: Int64[Tensor, " rows"]
) -> DemonstrationCorrelation:
    """Estimate the correlation along demonstrations from whitened residuals.

    The square of the autocorrelation at a distance is estimated without bias by products over pairs of
    different demonstrations, up to the distance where it first is not positive; the decay is that of the
    exponential with the same sum over all pairs of samples.
    """
    limit = math.sqrt(x.shape[1])
    scaled = whitened / whitened.square().mean(0).clamp_min(1e-300).sqrt()
    parts, n_chosen = [], 0
    for rows in _chosen_rows(x, group):
        parts += [_products_by_distance(x[some], scaled[some], limit) for some in rows.split(_together(rows))]
        n_chosen += rows.numel()
    independent = torch.ones_like(whitened[0])
    if sum(len(pairs) for _, pairs in parts) < 2:
        return DemonstrationCorrelation(0.0 * independent, independent)
    products, pairs = (torch.cat(part) for part in zip(*parts, strict=True))
    total = pairs.sum(0)
    sum_of_squares = (_squared_autocorrelation(products, pairs) * total[:, None]).sum(0)
    # Of n samples all pairs but those of a sample with itself; were some left out, there are as many more of each.
    share = 1.0 / (1.0 + 2.0 * sum_of_squares / n_chosen * len(x) / n_chosen)
    correlated = share <= _INDEPENDENT
    if not bool(correlated.any()):
        return DemonstrationCorrelation(0.0 * independent, independent)
    centre = (torch.arange(_N_BINS).to(x) + 0.5) * limit / _N_BINS
    decay = _decay_of(sum_of_squares, centre, total)
    return DemonstrationCorrelation(torch.where(correlated, decay, 0.0), torch.where(correlated, share, 1.0))


def _chosen_rows(x: Tensor, group: Tensor) -> list[Int64[Tensor, "g t"]]:
    """Rows of each demonstration along the first input, those of as many rows together."""
    counts = torch.bincount(group)
    order = x[:, 0].argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    by_size: dict[int, list[Tensor]] = {}
    for rows in order.split(counts.tolist()):
        chosen = rows[:: math.ceil(len(rows) / _MAX_SAMPLES) or 1]
        if len(rows) > 1:
            by_size.setdefault(len(chosen), []).append(chosen)
    return [torch.stack(same) for same in by_size.values()]


def _together(rows: Tensor) -> int:
    """Demonstrations whose pairs are taken at once."""
    return max(1, _MAX_PAIRS // rows.shape[1] ** 2)


def _products_by_distance(
    x: Float[Tensor, "g t e"], values: Float[Tensor, "g t d"], limit: float
) -> tuple[Float[Tensor, "g k d"], Float[Tensor, "g k"]]:
    """Sums of the products of pairs of samples of each of g demonstrations, and the numbers of pairs, by distance."""
    n_demos, n_outputs = len(x), values.shape[-1]
    i, j = torch.triu_indices(x.shape[1], x.shape[1], offset=1, device=x.device)
    distance = (x[:, i] - x[:, j]).norm(dim=-1)
    edges = limit * torch.arange(1, _N_BINS).to(x) / _N_BINS + 1e-9
    number = torch.bucketize(distance, edges)
    number = torch.where(distance <= limit, number, _N_BINS)  # the last bin is of those that are too far apart
    number = (number + (_N_BINS + 1) * torch.arange(n_demos, device=x.device)[:, None]).flatten()
    size = n_demos * (_N_BINS + 1)
    products = x.new_zeros(size, n_outputs).index_add_(0, number, (values[:, i] * values[:, j]).flatten(0, 1))
    pairs = torch.bincount(number, minlength=size).to(x)
    return products.reshape(n_demos, -1, n_outputs)[:, :-1], pairs.reshape(n_demos, -1)[:, :-1]


def _squared_autocorrelation(products: Float[Tensor, "g k d"], pairs: Float[Tensor, "g k"]) -> Float[Tensor, "k d"]:
    """In each bin of distance, of each output; zero from where it first is not positive."""
    own = products / pairs.clamp_min(1.0).unsqueeze(-1)
    present = (pairs > 0).sum(0).to(products)[:, None]
    cross = own.sum(0).square() - own.square().sum(0)
    square = (cross / (present * (present - 1.0)).clamp_min(1.0)).clamp(max=1.0)
    ended = ((present > 1) & (square <= 0)).cumsum(0) > 0
    return torch.where((present > 1) & ~ended, square, 0.0)


def _decay_of(target: Float[Tensor, " d"], distance: Float[Tensor, " k"], pairs: Float[Tensor, " k"]) -> Tensor:
    """Decays (d,) whose exponentials sum to the targets over the pairs, by bisection."""
    low, high = torch.full_like(target, 1e-4), torch.full_like(target, 1e2)
    for _ in range(60):
        middle = (low * high).sqrt()
        too_short = torch.exp(-distance / middle[:, None]) @ pairs < target
        low, high = torch.where(too_short, middle, low), torch.where(too_short, high, middle)
    return (low * high).sqrt()
