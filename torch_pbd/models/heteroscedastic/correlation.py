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
    """Distance over which the correlation of squared residuals falls by e, of standardized inputs; 0 if none does."""
    effective_share: float
    """Independent samples that a sample counts for."""

    def whitener(
        self, inputs: Float[Tensor, "n e"], occurrences: Float[Tensor, "g n"], *, squares: bool
    ) -> Float[Tensor, "n n"] | None:
        """Matrix that makes the means (or mean squares) at the inputs independent and of unit variance.

        ``occurrences`` are the rows of each of g demonstrations at each input. None if it is the unit matrix.
        """
        if self.decay == 0.0:
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
    limit = math.sqrt(x.shape[1])
    scaled = whitened / whitened.square().mean(0).clamp_min(1e-300).sqrt()
    tables = []
    n_samples = 0
    for name in group.unique():
        rows = (group == name).nonzero().squeeze(-1)
        rows = rows[:: max(1, math.ceil(len(rows) / _MAX_SAMPLES))]
        tables.append(_products_by_distance(x[rows], scaled[rows], limit))
        n_samples += len(rows)
    if len(tables) < 2:
        return INDEPENDENT
    products, pairs = (torch.stack(part) for part in zip(*tables, strict=True))
    total = pairs.sum(0)
    sum_of_squares = float((_squared_autocorrelation(products, pairs) * total).sum())
    share = 1.0 / (1.0 + 2.0 * sum_of_squares / n_samples)
    if share > _INDEPENDENT:
        return INDEPENDENT
    centre = (torch.arange(_N_BINS).to(x) + 0.5) * limit / _N_BINS
    return DemonstrationCorrelation(_decay_of(sum_of_squares, centre, total), share)


def _products_by_distance(x: Tensor, values: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Sums of the products of pairs of one demonstration (bins, d), and the number of pairs (bins,)."""
    i, j = torch.triu_indices(len(x), len(x), offset=1, device=x.device)
    distance = (x[i] - x[j]).norm(dim=-1)
    near = distance <= limit
    edges = torch.linspace(0.0, limit, _N_BINS + 1).to(x)[1:-1]
    number = torch.bucketize(distance[near], edges)
    products = x.new_zeros(_N_BINS, values.shape[1]).index_add_(0, number, (values[i] * values[j])[near])
    return products, torch.bincount(number, minlength=_N_BINS).to(x)


def _squared_autocorrelation(products: Float[Tensor, "g k d"], pairs: Float[Tensor, "g k"]) -> Float[Tensor, " k"]:
    """Its mean over the outputs in each bin of distance; zero from where it first is not positive."""
    own = products / pairs.clamp_min(1.0).unsqueeze(-1)
    present = (pairs > 0).sum(0).to(products)
    cross = own.sum(0).square() - own.square().sum(0)
    square = (cross / (present * (present - 1.0)).clamp_min(1.0).unsqueeze(-1)).mean(1).clamp(max=1.0)
    ended = ((present > 1) & (square <= 0)).cumsum(0) > 0
    return torch.where((present > 1) & ~ended, square, 0.0)


def _decay_of(target: float, distance: Tensor, pairs: Tensor) -> float:
    """Decay whose exponential sums to the target over the pairs, by bisection."""
    low, high = 1e-4, 1e2
    for _ in range(60):
        middle = math.sqrt(low * high)
        too_short = float((pairs * torch.exp(-distance / middle)).sum()) < target
        low, high = (middle, high) if too_short else (low, middle)
    return math.sqrt(low * high)


def occurrences_of(index: Int64[Tensor, " rows"], group: Int64[Tensor, " rows"], n_inputs: int) -> Float[Tensor, "g n"]:
    """Rows of each demonstration at each distinct input."""
    names, number = group.unique(return_inverse=True)
    flat = torch.bincount(number * n_inputs + index, minlength=len(names) * n_inputs)
    return flat.reshape(len(names), n_inputs).to(torch.float64)
