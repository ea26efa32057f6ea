"""Where the evidence of Gaussian processes is searched: a grid, and the coordinates between its points."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import max_pool2d

from torch_pbd.gp.evidence import Evidence
from torch_pbd.gp.observations import Observations
from torch_pbd.gp.projection import Basis, Projection, resolutions

MIN_NOISE_RATIO, MAX_NOISE_RATIO = 1e-10, 1e5
"""Bounds of a learned noise variance over the variance of the process; a fixed noise may be far lower."""

_ENTRIES = 1 << 20  # of the matrices that are treated together: they stay near the cache, and memory is bounded
# Largest ratio of neighbouring length scales of the grid, and where a decomposition costs nearly nothing.
_GRID_STEP, _FINE_STEP, _SMALL = 1.4, 1.25, 24

# Where the evidence is nearly flat in the ratio no optimum is lost between coarser steps.
_LOG10_RATIOS = (-10.0, -8.0, -6.0, -5.0, -4.0, *(0.25 * step for step in range(-14, 7)), 2.0, 3.0, 4.0)

# Points that a local minimum of the grid is the lowest of: of fewer, points along one valley would be several.
_AROUND = (5, 7)
_FEW = 2e7  # multiplications of a decomposition of all processes
_LAGS = 3
_NOT_WHITE = 21.1  # 0.9999 quantile of the chi-squared distribution of three degrees of freedom


@dataclass(frozen=True)
class EvidenceSearch:
    """What :func:`fit_hyperparameters` looks for, and where.

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


class Coordinates:
    """Unbounded coordinates of the hyperparameters that are searched; the rest are fixed or closed-form.

    A cosine folds each onto its bounds: unlike a sigmoid it reaches them, so an optimum there is found.
    """

    def __init__(
        self,
        evidence: Evidence,
        length_scale: Float[Tensor, " e"] | None,
        bounds: list[tuple[float, Float[Tensor, " b"] | float]],
    ) -> None:
        self.evidence, self.fixed = evidence, length_scale
        n_length_scales = evidence.projection.basis.nodes.shape[1] if length_scale is None else 0
        self.noisy = len(bounds) > n_length_scales
        like = evidence.projection.targets[:, 0]
        low = [math.log(lowest) + 0.0 * like for lowest, _ in bounds]
        high = [torch.as_tensor(highest, dtype=like.dtype).to(like).log() + 0.0 * like for _, highest in bounds]
        self.low = torch.stack([*low, like], dim=1)[:, :-1]
        self.half_width = 0.5 * (torch.stack([*high, like], dim=1)[:, :-1] - self.low)

    def decode(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Length scales (a, e) and noise ratio (a,)."""
        values = (self.low[rows] + self.half_width[rows] * (1.0 - torch.cos(z))).exp()
        length_scale = self.fixed.expand(len(z), -1) if self.fixed is not None else values
        if not self.noisy:
            return length_scale, z.new_zeros(len(z))
        return length_scale if self.fixed is not None else values[:, :-1], values[:, -1]

    def encode(self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Tensor) -> Tensor:
        """Coordinates (a, p), off the bounds by a little: there they have no slope."""
        parts = [length_scale] * (self.fixed is None) + [noise_ratio[:, None]] * self.noisy
        logs = torch.cat([*parts, length_scale[:, :0]], dim=1).log()
        share = 0.5 * (logs - self.low[rows]) / self.half_width[rows].clamp_min(1e-9)
        return torch.acos(1.0 - 2.0 * share.clamp(0.01, 0.99))

    def loss(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Negative log evidence in nats, and its gradient."""
        loss, gradient = self.evidence(*self.decode(z, rows), rows)
        parts = [gradient.log_length_scale] * (self.fixed is None) + [gradient.log_noise_ratio[:, None]] * self.noisy
        by_z = torch.cat([*parts, z[:, :0]], dim=1) * self.half_width[rows] * torch.sin(z)
        return loss, by_z


class EvidenceGrid:
    """The evidence on a grid of isotropic length scales and noise ratios, refined where it has to be.

    It begins with the length scales that few nodes carry. Shorter ones, of more nodes, follow where the shortest so
    far is the best one for a process, or where what a process leaves unexplained is no white noise.
    """

    def __init__(self, observations: Observations, search: EvidenceSearch, longest: Float[Tensor, " b"]) -> None:
        self._observations, self._search, self._longest = observations, search, longest
        noise, fixed = search.noise_scale, search.length_scale
        self._noisy = noise is None or bool((noise > 0).all())
        self._ratios = _noise_ratios(observations, noise) if self._noisy else observations.targets.new_zeros(1)
        self._shortest = search.length_scale_bounds[0] if fixed is None else float(fixed.min())
        levels = resolutions(observations, search.kernel, noisy=self._noisy, max_inputs=search.max_inputs)
        # Of those that carry all length scales there are, only the coarsest.
        carrying = [i for i, level in enumerate(levels) if level.shortest_length_scale <= self._shortest]
        last = carrying[0] if carrying else len(levels) - 1
        self._levels = levels[: last + 1] if fixed is None else levels[last : last + 1]
        self._scales = observations.targets.new_zeros(0)
        self._table = observations.targets.new_zeros(len(observations.targets), 0, len(self._ratios))
        self.processes = torch.arange(len(observations.targets), device=observations.targets.device)
        """Those that are still searched."""
        self._level, self._bases = -1, list[tuple[float, Basis]]()
        self.refine()

    @property
    def finest(self) -> bool:
        """Whether there are no shorter length scales to try."""
        return self._level == len(self._levels) - 1

    @property
    def shortest(self) -> float:
        """Shortest length scale of this level."""
        return max(self._shortest, self._levels[self._level].shortest_length_scale)

    @property
    def few(self) -> bool:
        """Whether the next level is so cheap that there is nothing to gain by leaving processes behind."""
        level = self._levels[self._level + 1]
        n_nodes = level.n_nodes or level.max_inputs or len(self._observations.counts)
        return len(self.processes) * n_nodes**3 <= _FEW

    def keep(self, chosen: Bool[Tensor, " b"]) -> None:
        """Leave the other processes behind."""
        noise = self._search.noise_scale
        self._observations = replace(self._observations, targets=self._observations.targets[chosen])
        self._search = replace(self._search, noise_scale=None if noise is None else noise[chosen])
        self._longest, self._table = self._longest[chosen], self._table[chosen]
        self.processes = self.processes[chosen]

    def refine(self) -> None:
        """Add the length scales that the next level carries."""
        longest = self.shortest if self._level >= 0 else max(self._shortest, float(self._longest.max()))
        self._level += 1
        basis = Basis.of(self._observations, self._levels[self._level])
        self._bases.append((self.shortest, basis))
        projection = basis.project(self._observations.targets)
        self.evidence = Evidence.of(projection, self._search.kernel, self._search.noise_scale)
        n_features, fixed = projection.basis.nodes.shape[1], self._search.length_scale
        if fixed is None:
            step = _FINE_STEP if len(projection.basis.nodes) <= _SMALL else _GRID_STEP
            n_steps = max(0, math.ceil(math.log(longest / self.shortest) / math.log(step) - 1e-9))
            new = torch.logspace(math.log10(self.shortest), math.log10(longest), n_steps + 1, dtype=self._scales.dtype)
            new = new.to(self._scales.device)
            new = new[:-1] if len(self._scales) else new
            each = new[:, None].expand(-1, n_features)
        else:
            new, each = fixed[:1], fixed[None]
        parts = [self.evidence.table(part, self._ratios) for part in each.split(together(projection))]
        table = torch.cat(parts, dim=1)
        # A process whose bound lies between two length scales of the grid keeps the nearer one above it.
        beyond = new > _GRID_STEP**0.5 * self._longest[:, None]
        table = table.masked_fill((beyond & (fixed is None)).unsqueeze(-1), math.inf)
        self._scales = torch.cat([new, self._scales])
        self._table = torch.cat([table, self._table], dim=1)

    def basis_for(self, length_scale: Float[Tensor, "b e"]) -> Basis:
        """The smallest basis so far that carries length scales."""
        shortest = 1.0001 * float(length_scale.min())  # a search ends at the bound but for rounding
        return next((basis for least, basis in self._bases if shortest >= least), self._bases[-1][1])

    def coordinates(self) -> Coordinates:
        """Those of a search within the grid."""
        fixed = self._search.length_scale
        n_length_scales = 0 if fixed is not None else self._observations.inputs.shape[1]
        bounds: list[tuple[float, Tensor | float]] = [(self.shortest, self._longest)] * n_length_scales
        bounds += [(float(self._ratios[0]), MAX_NOISE_RATIO)] * self._noisy
        return Coordinates(self.evidence, fixed, bounds)

    def valleys(self, most: int) -> tuple[Tensor, Tensor, Tensor]:
        """Length scales (b, v, e), noise ratios (b, v) and loss (b, v) of the deepest local minima, in nats.

        The evidence often has one optimum where the data are signal and one where they are noise, with a plateau
        between. Where there are fewer than ``most`` the loss is infinite, and the length scale the shortest.
        """
        surrounding = -max_pool2d(-self._table, _AROUND, stride=1, padding=(_AROUND[0] // 2, _AROUND[1] // 2))
        minima = torch.where(self._table <= surrounding, self._table, math.inf).flatten(1)
        loss, place = minima.topk(min(most, minima.shape[1]), dim=1, largest=False)
        place = torch.where(loss.isfinite(), place, 0)
        scale = self._scales[place // len(self._ratios)].unsqueeze(-1)
        fixed = self._search.length_scale
        length_scale = (
            scale.expand(-1, -1, self._observations.inputs.shape[1])
            if fixed is None
            else fixed.expand(*place.shape, -1)
        )
        return length_scale, self._ratios[place % len(self._ratios)], loss

    def unsettled(self) -> Bool[Tensor, " b"]:
        """For which processes length scales below those of the grid may be better."""
        best = self._table.flatten(1).argmin(1)
        scale, ratio = best // len(self._ratios), best % len(self._ratios)
        if self.finest:
            return torch.zeros_like(best, dtype=torch.bool)
        residual = self.evidence.residual(self._scales[scale][:, None], self._ratios[ratio])
        residual = residual[:, self._observations.inputs[:, 0].argsort()]
        total = residual.square().sum(1).clamp_min(1e-300)
        products = [(residual[:, lag:] * residual[:, :-lag]).sum(1) / total for lag in range(1, _LAGS + 1)]
        return (scale == 0) | (residual.shape[1] * torch.stack(products).square().sum(0) > _NOT_WHITE)


def _noise_ratios(observations: Observations, noise_scale: Tensor | None) -> Tensor:
    """Of the grid; a fixed noise must leave room for amplitudes a hundred times the targets."""
    ratios = 10.0 ** observations.targets.new_tensor(_LOG10_RATIOS)
    if noise_scale is None:
        return ratios
    largest = float(observations.targets.square().mean(1).max())
    lowest = max(float(noise_scale.min()) ** 2 / max(1e4 * largest, 1e-200), 1e-40)
    lower = range(math.ceil(math.log10(lowest)), int(_LOG10_RATIOS[0]))
    below = [lowest] * (lowest < 0.999 * MIN_NOISE_RATIO) + [10.0**exponent for exponent in lower]
    return torch.cat([ratios.new_tensor(sorted(set(below))), ratios])


def together(projection: Projection) -> int:
    """How many covariances are treated at a time."""
    return max(1, _ENTRIES // len(projection.basis.nodes) ** 2)
