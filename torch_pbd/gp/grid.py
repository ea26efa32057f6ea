"""Grid on which the evidence of Gaussian processes is searched, and coordinates between its points."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from torch_pbd.gp.latent import Evidence
from torch_pbd.gp.observations import Basis, Observations, Resolution, resolutions

# Bounds of a learned noise variance over the variance of the process; a fixed noise may be far lower.
_MIN_NOISE_RATIO, _MAX_NOISE_RATIO = 1e-10, 1e5

# Entries of the matrices that are treated together: they stay near the cache, and memory is bounded.
_ENTRIES = 1 << 20

# Largest ratio of neighbouring length scales of the grid; a finer one where nodes are so few that a decomposition
# costs nearly nothing. With the coarse one alone 3 of 1200 made-up processes lost up to 0.4 nats.
_GRID_STEP, _FINE_STEP, _SMALL = 1.4, 1.25, 24

# Where the evidence is nearly flat in the ratio no optimum is lost between coarser steps.
_LOG10_RATIOS = (-10.0, -8.0, -6.0, -5.0, -4.0, *(0.25 * step for step in range(-14, 7)), 2.0, 3.0, 4.0)

# Points that a local minimum of the grid is the lowest of: of fewer, points along one valley would be several.
_AROUND = (5, 7)

# Residuals whose first autocorrelations, squared and summed, are above the 0.9999 quantile of the chi-squared
# distribution of as many degrees of freedom are no white noise.
_LAGS, _NOT_WHITE = 3, 21.1


@dataclass(frozen=True)
class EvidenceSearch:
    """Bounds, held values and limits of a search for hyperparameters.

    Parameters
    ----------
    kernel : str
    length_scale_bounds : (float, float)
        Smallest and largest length scale, in units of the range of the inputs. A lower bound at the spacing
        of the inputs keeps out "needles", which explain every point by itself and nothing between.
    length_scale : Tensor of shape (e,) or None
        Held there if given.
    noise_scale : Tensor of shape (b,) or None
        Standard deviation of the noise of one observation, held there if given; learned if None.
    max_inputs : int or None
        Inputs beyond which neighbours are merged, for length scales so short that no lower rank carries them.
    n_restarts : int
        Valleys of the grid to descend into beside the deepest.
    max_iter, tol
        Of the optimization that polishes the grid's points; the tolerance in nats, as in
        :func:`~torch_pbd.optim.minimize_batch`.
    """

    kernel: str = "squared_exponential"
    length_scale_bounds: tuple[float, float] = (1e-3, 1e1)
    length_scale: Tensor | None = None
    noise_scale: Tensor | None = None
    max_inputs: int | None = None
    n_restarts: int = 2
    max_iter: int = 100
    tol: float = 0.005


class EvidenceGrid:
    """The evidence on a grid of isotropic length scales and noise ratios, of the processes still searched.

    It begins with the length scales that few nodes carry; :meth:`refine` adds shorter ones, of more nodes.
    """

    evidence: Evidence
    """Evidence in the basis of the present level."""

    def __init__(self, observations: Observations, search: EvidenceSearch, longest: Float[Tensor, " b"]) -> None:
        self._observations, self._search, self._longest = observations, search, longest
        noise, self._fixed = search.noise_scale, search.length_scale
        self._noisy = noise is None or bool((noise > 0).all())
        self._ratios = _noise_ratios(observations, noise) if self._noisy else observations.targets.new_zeros(1)
        self._shortest = search.length_scale_bounds[0] if self._fixed is None else float(self._fixed.min())
        levels = resolutions(observations, search.kernel, noisy=self._noisy, max_inputs=search.max_inputs)
        # Of those that carry all length scales there are, only the coarsest.
        carrying = [i for i, level in enumerate(levels) if level.shortest_length_scale <= self._shortest]
        last = carrying[0] if carrying else len(levels) - 1
        self._finer = levels[: last + 1] if self._fixed is None else levels[last : last + 1]
        self._scales = observations.targets.new_zeros(0)
        self._table = observations.targets.new_zeros(len(observations.targets), 0, len(self._ratios))
        self.processes = torch.arange(len(observations.targets), device=observations.targets.device)
        """Indices of the processes that are still searched."""
        self.bases: list[tuple[float, Basis]] = []
        """Shortest length scale of each level so far, and its basis."""

    @property
    def next_level(self) -> Resolution | None:
        """Resolution of shorter length scales that are still to be tried."""
        return self._finer[0] if self._finer else None

    @property
    def shortest(self) -> float:
        """Shortest length scale of this level."""
        return self.bases[-1][0]

    def keep(self, chosen: Bool[Tensor, " b"]) -> None:
        """Leave the other processes behind."""
        noise = self._search.noise_scale
        self._observations = replace(self._observations, targets=self._observations.targets[chosen])
        self._search = replace(self._search, noise_scale=None if noise is None else noise[chosen])
        self._longest, self._table = self._longest[chosen], self._table[chosen]
        self.processes = self.processes[chosen]

    def refine(self) -> None:
        """Add the length scales that the next level carries."""
        level = self._finer.pop(0)
        least = max(self._shortest, level.shortest_length_scale)
        longest = self.shortest if self.bases else max(self._shortest, float(self._longest.max()))
        basis = Basis(self._observations, level)
        self.bases.append((least, basis))
        self.evidence = Evidence(basis, self._observations.targets, self._search.kernel, self._search.noise_scale)
        if self._fixed is None:
            step = _FINE_STEP if len(basis.nodes) <= _SMALL else _GRID_STEP
            n_steps = max(0, math.ceil(math.log(longest / least) / math.log(step) - 1e-9))
            new = torch.logspace(math.log10(least), math.log10(longest), n_steps + 1, dtype=self._scales.dtype)
            new = new.to(self._scales.device)
            new = new[:-1] if len(self._scales) else new
            each = new[:, None].expand(-1, basis.nodes.shape[1])
        else:
            new, each = self._fixed[:1], self._fixed[None]
        table = torch.cat([self.evidence.table(part, self._ratios) for part in each.split(together(basis))], dim=1)
        if self._fixed is None:
            # A process whose bound lies between two length scales of the grid keeps the nearer one above it.
            beyond = new > _GRID_STEP**0.5 * self._longest[:, None]
            table = table.masked_fill(beyond.unsqueeze(-1), math.inf)
        self._scales = torch.cat([new, self._scales])
        self._table = torch.cat([table, self._table], dim=1)

    def valleys(self, most: int) -> tuple[Tensor, Tensor, Tensor]:
        """Length scales (b, v, e), noise ratios (b, v) and loss (b, v) of the deepest local minima, in nats.

        The evidence often has one optimum where the data are signal and one where they are noise, with a plateau
        between. Where there are fewer than ``most`` the loss is infinite, and the length scale the shortest.
        """
        surrounding = -max_pool2d(-self._table, _AROUND, stride=1, padding=(_AROUND[0] // 2, _AROUND[1] // 2))
        minima = torch.where(self._table <= surrounding, self._table, math.inf).flatten(1)
        loss, place = minima.topk(min(most, minima.shape[1]), dim=1, largest=False)
        place = torch.where(loss.isfinite(), place, 0)
        scale = self._scales[place // len(self._ratios)].unsqueeze(-1) if self._fixed is None else self._fixed
        length_scale = scale.expand(*place.shape, self._observations.inputs.shape[1])
        return length_scale, self._ratios[place % len(self._ratios)], loss

    def unsettled(self) -> Bool[Tensor, " b"]:
        """Whether length scales below those of the grid may be better, for each process.

        They may where the shortest so far is the best one, or where what a process leaves unexplained is no white
        noise.
        """
        best = self._table.flatten(1).argmin(1)
        scale, ratio = best // len(self._ratios), best % len(self._ratios)
        if self.next_level is None:
            return torch.zeros_like(best, dtype=torch.bool)
        residual = self.evidence.residual(self._scales[scale][:, None], self._ratios[ratio])
        residual = residual[:, self._observations.inputs[:, 0].argsort()]
        total = residual.square().sum(1).clamp_min(1e-300)
        products = [(residual[:, lag:] * residual[:, :-lag]).sum(1) / total for lag in range(1, _LAGS + 1)]
        return (scale == 0) | (residual.shape[1] * torch.stack(products).square().sum(0) > _NOT_WHITE)

    def coordinates(self) -> "Coordinates":
        """Coordinates of a search within the grid."""
        n_features = self._observations.inputs.shape[1]
        # Columns of (log length scales, log noise ratio) that are searched.
        free = slice(0 if self._fixed is None else n_features, n_features + self._noisy)
        low = [math.log(self.shortest)] * n_features + [math.log(float(self._ratios[0]) or 1.0)]
        high = [self._longest.log()] * n_features + [torch.full_like(self._longest, _MAX_NOISE_RATIO).log()]
        lower = self._longest.new_tensor(low).expand(len(self._longest), -1)
        return Coordinates(self.evidence, self._fixed, free, lower[:, free], torch.stack(high, dim=1)[:, free])


class Coordinates:
    """Unbounded coordinates of the hyperparameters that are searched; the rest are fixed or closed-form.

    A cosine folds each onto its bounds: unlike a sigmoid it reaches them, so an optimum there is found.
    """

    def __init__(self, evidence: Evidence, fixed: Tensor | None, free: slice, low: Tensor, high: Tensor) -> None:
        self._evidence, self._fixed, self._free = evidence, fixed, free
        self._low, self._half_width = low, 0.5 * (high - low)

    def decode(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Length scales (a, e) and noise ratio (a,)."""
        values = (self._low[rows] + self._half_width[rows] * (1.0 - torch.cos(z))).exp()
        n_features = self._evidence.basis.nodes.shape[1]
        length_scale = values[:, :n_features] if self._fixed is None else self._fixed.expand(len(z), -1)
        return length_scale, values[:, -1] if self._free.stop > n_features else z.new_zeros(len(z))

    def encode(self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Tensor) -> Tensor:
        """Coordinates (a, p), off the bounds by a little: there they have no slope."""
        logs = torch.cat([length_scale, noise_ratio[:, None]], dim=1)[:, self._free].log()
        share = 0.5 * (logs - self._low[rows]) / self._half_width[rows].clamp_min(1e-9)
        return torch.acos(1.0 - 2.0 * share.clamp(0.01, 0.99))

    def loss(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Negative log evidence in nats, and its gradient."""
        loss, gradient = self._evidence(*self.decode(z, rows), rows)
        return loss, gradient[:, self._free] * self._half_width[rows] * torch.sin(z)


def _noise_ratios(observations: Observations, noise_scale: Tensor | None) -> Tensor:
    """Noise ratios of the grid; a fixed noise must leave room for amplitudes a hundred times the targets."""
    ratios = 10.0 ** observations.targets.new_tensor(_LOG10_RATIOS)
    if noise_scale is None:
        return ratios
    largest = float(observations.targets.square().mean(1).max())
    lowest = max(float(noise_scale.min()) ** 2 / max(1e4 * largest, 1e-200), 1e-40)
    lower = range(math.ceil(math.log10(lowest)), int(_LOG10_RATIOS[0]))
    below = [lowest] * (lowest < 0.999 * _MIN_NOISE_RATIO) + [10.0**exponent for exponent in lower]
    return torch.cat([ratios.new_tensor(sorted(set(below))), ratios])


def together(basis: Basis) -> int:
    """How many covariances are treated at a time."""
    return max(1, _ENTRIES // len(basis.nodes) ** 2)
