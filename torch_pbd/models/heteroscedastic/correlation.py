"""How much the samples of one demonstration repeat each other, and what that leaves to learn from."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import safe_cholesky

_N_BINS = 50  # of the distance between samples, up to the range of the inputs
_MAX_SAMPLES = 400  # of one demonstration; of longer ones a share
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

    decay: float
    """Distance over which the correlation of squared residuals falls by e, of standardized inputs."""
    effective_share: float
    """Independent samples that a sample counts for."""

    @property
    def matters(self) -> bool:
        return self.decay > 0

    def whitener(
        self, inputs: Float[Tensor, "n e"], occurrences: Float[Tensor, "g n"], *, squares: bool
    ) -> Float[Tensor, "n n"] | None:
        """Matrix that makes the means (or mean squares) at the inputs independent and of unit variance.

        ``occurrences`` are the rows of each of g demonstrations at each input. None if it is the unit matrix.
        """
        if not self.matters:
            return None
        distance = torch.cdist(inputs, inputs, compute_mode="donot_use_mm_for_euclid_dist")
        correlation = torch.exp(-distance / (self.decay if squares else 2.0 * self.decay))
        counts = occurrences.sum(0)
        shared = occurrences.mT @ occurrences / (counts[:, None] * counts).sqrt()
        factor = safe_cholesky(correlation * shared, name="the correlation of the demonstrations")
        return torch.linalg.solve_triangular(factor, torch.eye(len(counts)).to(factor), upper=False)


INDEPENDENT = DemonstrationCorrelation(0.0, 1.0)


def demonstration_correlation(
    x: Float[Tensor, "rows e"], whitened: Float[Tensor, "rows d"], group: Int64[Tensor, " rows"]
) -> DemonstrationCorrelation:
    """Estimate the correlation along demonstrations from whitened residuals.

    The square of the autocorrelation at a distance is estimated without bias by products over pairs of
    different demonstrations, up to the distance where it first is not positive; the decay is that of the
    exponential with the same sum over all pairs of samples.
    """
    names = group.unique()
    if len(names) < 2:
        return INDEPENDENT
    products, pairs, n_samples = [], [], 0
    limit = math.sqrt(x.shape[1])
    edges = torch.linspace(0.0, limit, _N_BINS + 1).to(x)[1:-1]
    for name in names:
        rows = (group == name).nonzero().squeeze(-1)
        rows = rows[:: max(1, math.ceil(len(rows) / _MAX_SAMPLES))]
        n_samples += len(rows)
        i, j = torch.triu_indices(len(rows), len(rows), offset=1, device=x.device)
        distance = (x[rows[i]] - x[rows[j]]).norm(dim=-1)
        near = distance <= limit
        bin_of = torch.bucketize(distance[near], edges)
        product = (whitened[rows[i]] * whitened[rows[j]])[near]
        products.append(x.new_zeros(_N_BINS, product.shape[1]).index_add_(0, bin_of, product))
        pairs.append(torch.bincount(bin_of, minlength=_N_BINS).to(x))
    pair_counts = torch.stack(pairs)
    own = torch.stack(products) / pair_counts.clamp_min(1.0).unsqueeze(-1) / whitened.square().mean(0).clamp_min(1e-300)
    present = (pair_counts > 0).sum(0).to(x)
    cross = own.sum(0).square() - own.square().sum(0)
    square = (cross / (present * (present - 1.0)).clamp_min(1.0).unsqueeze(-1)).mean(1).clamp(max=1.0)
    known = present > 1
    negative = known & (square <= 0)
    end = int(negative.nonzero()[0]) if bool(negative.any()) else _N_BINS
    square = torch.where(known, square, 0.0)
    square[end:] = 0.0
    total = pair_counts.sum(0)
    excess = 2.0 * float((square * total).sum()) / n_samples
    share = 1.0 / (1.0 + excess)
    if share > _INDEPENDENT:
        return DemonstrationCorrelation(0.0, 1.0)
    centre = (torch.arange(_N_BINS).to(x) + 0.5) * limit / _N_BINS
    return DemonstrationCorrelation(_decay_of(excess * n_samples / 2.0, centre, total), share)


def _decay_of(excess: float, distance: Tensor, pairs: Tensor) -> float:
    """Decay whose exponential sums to ``excess`` over the pairs, by bisection."""
    low, high = 1e-4, 1e2
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if float((pairs * torch.exp(-distance / middle)).sum()) < excess else (low, middle)
    return math.sqrt(low * high)


def occurrences_of(
    index: Int64[Tensor, " rows"], group: Int64[Tensor, " rows"] | None, n_inputs: int
) -> Float[Tensor, "g n"] | None:
    """Rows of each demonstration at each distinct input; None where demonstrations are not told."""
    if group is None:
        return None
    names, number = group.unique(return_inverse=True)
    flat = torch.bincount(number * n_inputs + index, minlength=len(names) * n_inputs)
    return flat.reshape(len(names), n_inputs).to(torch.float64)
