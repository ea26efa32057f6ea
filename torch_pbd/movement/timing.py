"""Duration and pace of movements: learned from demonstrations, and estimated while a movement runs.

A movement at time t of its duration T, u = t / T, has the phase s from 0 to 1:

    ``s = (1 - exp(-a u)) / (1 - exp(-a))``, so that ``exp(a)`` is its pace at the start over that at the end.

The phase increases for every a, and a = 0 is an even pace. The law of ``(log T, a)`` is learned.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

_PACES = torch.linspace(-3.0, 3.0, 121, dtype=torch.float64)  # exp(3): twenty times as fast at the start as at the end
_ROUNDS = 10  # rounds of registration: the mean and the paces depend on each other
_EVEN = 1e-5  # magnitude of a below which its series is exact to rounding
_SAME = 1e-4  # spread of log durations that counts as none, since sampling makes as much
# Nodes along a side of successively finer lattices, until the posterior is wider than their cells, and of the last one,
# whose nodes all predict. They reach over four standard deviations: with nodes 4/3 of one apart, a sum is a normal
# integral to 1e-4. A normal density 0.7 cells wide has the weight of 2.5 nodes along each axis.
_SIDE, _SIDE_LAST, _REACH, _MOST_LATTICES, _FEW = 13, 6, 4.0, 20, 2.5
_LEAST_POWER = 1e-9
_RARE = 7.0  # the first lattice ends where the density is this many nats below that of its middle

Likelihood = Callable[[Tensor, Tensor], Tensor]


class Nodes(NamedTuple):
    """Posterior of duration and pace as weighted nodes, and log of the integral of prior times likelihood."""

    duration: Float[Tensor, " b"]
    pace: Float[Tensor, " b"]
    weight: Float[Tensor, " b"]
    log_integral: float


def phases(time: Float[Tensor, " n"], duration: Float[Tensor, " b"], pace: Float[Tensor, " b"]) -> Float[Tensor, "b n"]:
    """Phases at these times, for each of some durations and paces."""
    return phase_of(time / duration[:, None], pace[:, None])


def phase_of(time: Tensor, pace: Tensor) -> Tensor:
    """Phase at times in durations of the movement; 1 after the end."""
    u, even = time.clamp(max=1.0), pace.abs() < _EVEN
    safe = torch.where(even, 1.0, pace)
    return torch.where(even, u + 0.5 * pace * u * (1.0 - u), torch.expm1(-safe * u) / torch.expm1(-safe))


def time_of(phase: Tensor, pace: Tensor) -> Tensor:
    """Time in durations of the movement at which a phase is reached: the inverse of :func:`phase_of`."""
    even = pace.abs() < _EVEN
    safe = torch.where(even, 1.0, pace)
    series = phase - 0.5 * pace * phase * (1.0 - phase)
    return torch.where(even, series, -torch.log1p(phase * torch.expm1(-safe)) / safe)


def register(curves: Float[Tensor, "K n d"]) -> Float[Tensor, " K"]:
    """Paces, of mean zero, under which curves sampled evenly over their durations are nearest to their mean.

    Curves must be in comparable units. Least squares over a grid of paces alternates with the mean.
    """
    n_demos, n, _ = curves.shape
    paces, each = _PACES.to(curves), torch.arange(n_demos)
    place = time_of(torch.linspace(0.0, 1.0, n).to(curves), paces[:, None]) * (n - 1)
    left = place.long().clamp(0, n - 2)
    warped = torch.lerp(curves[:, left], curves[:, left + 1], (place - left)[:, :, None])
    chosen = torch.full((n_demos,), len(paces) // 2)
    for _ in range(_ROUNDS):
        before, mean = chosen, warped[each, chosen].mean(0)
        chosen = (warped - mean).square().sum((2, 3)).argmin(1)
        # The pace of the mean curve is arbitrary, so that all paces may be shifted.
        chosen = (chosen + len(paces) // 2 - chosen.double().mean().round().long()).clamp(0, len(paces) - 1)
        if torch.equal(chosen, before):
            break
    return paces[chosen] - paces[chosen].mean()


@dataclass(frozen=True)
class Timing:
    """Predictive Student's t of (log T, a) for the next movement, given K demonstrations that are normal in both."""

    location: Float[Tensor, " 2"]
    root: Float[Tensor, "2 2"]
    """Lower factor of its scale matrix; a column of zeros where demonstrations do not differ."""
    df: float

    @classmethod
    def learn(cls, duration: Float[Tensor, " K"], pace: Float[Tensor, " K"]) -> "Timing":
        """Predictive law from three or more demonstrations.

        For K normal pairs with mean m and sums of squares S, under Jeffreys' prior, the next pair has a t of K - 2
        degrees of freedom around m with the scale matrix ``(1 + 1 / K) S / (K - 2)``.
        """
        values, n_demos = torch.stack([duration.log(), pace], dim=1), len(pace)
        residual = values - values.mean(0)
        scale = (1.0 + 1.0 / n_demos) / (n_demos - 2) * residual.mT @ residual
        root = torch.zeros_like(scale)
        if float(scale[0, 0].sqrt()) > _SAME:
            root[:, 0] = scale[:, 0] / scale[0, 0].sqrt()
        root[1, 1] = (scale[1, 1] - root[1, 0].square()).clamp_min(0.0).sqrt()
        return cls(values.mean(0), root, float(n_demos - 2))

    def longest(self) -> float:
        """Longest duration of movements."""
        return float((self.location[0] + self._reach() * self.root[0, 0]).exp())

    def posterior(self, log_likelihood: Likelihood, last: float = 0.0, *, exact: Likelihood | None = None) -> Nodes:
        """Posterior of duration and pace, given a log likelihood of durations (b,) and paces (b,).

        The movement still runs at the time ``last``, at most :meth:`longest`, so its duration is no less. The more
        expensive likelihood ``exact`` is evaluated on last lattices of its own.
        """
        center, root = torch.zeros_like(self.location), self._reach() / _REACH * torch.eye(2).to(self.root)
        cut = -math.inf
        if last > 0.0 and self.root[0, 0] > 0.0:
            cut = float((math.log(last) - self.location[0]) / self.root[0, 0])
        for likelihood in filter(None, (log_likelihood, exact)):
            power = 0.0
            for _ in range(_MOST_LATTICES):
                nodes, center, root, power = self._lattice(likelihood, center, root, cut, _SIDE, power)
                if not self._is_narrow(nodes.weight):
                    break
        nodes, *_ = self._lattice(exact or log_likelihood, center, root, cut, _SIDE_LAST, 0.0)
        kept = nodes.weight > 1e-3 * nodes.weight.max()
        weight = nodes.weight[kept] / nodes.weight[kept].sum()
        return Nodes(nodes.duration[kept], nodes.pace[kept], weight, nodes.log_integral)

    def _lattice(
        self, log_likelihood: Likelihood, center: Tensor, root: Tensor, cut: float, side: int, least: float
    ) -> tuple[Nodes, Tensor, Tensor, float]:
        """Midpoints of a lattice's cells, and center and root of the next lattice with the power that placed it.

        Durations depend on the first axis alone, as ``root`` is a lower factor; it is cut where movements would have
        ended. Where too few nodes carry the weight, the likelihood is flattened by a power below one to place the next
        lattice. The power grows from lattice to lattice, above ``least``: a posterior that leans against the cut, with
        a long tail, would never be narrowed down.
        """
        low = min(max(float((cut - center[0]) / root[0, 0]), -_REACH), 0.9 * _REACH)
        axes, cell = [], root.new_ones(2)
        for axis, start in enumerate((low, -_REACH)):
            edges = torch.linspace(start, _REACH, side + 1).to(root)
            varies = bool(self.root[axis, axis] > 0.0)
            axes.append(0.5 * (edges[1:] + edges[:-1]) if varies else edges[:1] * 0.0)
            cell[axis] = edges[1] - edges[0] if varies else 12.0**0.5  # which keeps the root as it is
        z = center + torch.cartesian_prod(*axes) @ root.mT
        values = self.location + z @ self.root.mT
        duration, pace = values[:, 0].exp(), values[:, 1]
        n_varying = int((self.root.diagonal() > 0.0).sum())
        log_prior = -0.5 * (self.df + n_varying) * torch.log1p(z.square().sum(1) / self.df)
        value, power = log_likelihood(duration, pace), 1.0
        # At power zero only the prior is left, which may itself be narrow on a first lattice.
        while self._is_narrow(wide := (log_prior + power * value).softmax(0)) and power > 2.0 * least:
            power = 0.5 * power if power > _LEAST_POWER else 0.0
        log_weight = log_prior + value
        scale = root * cell
        center = wide @ z
        spread = z - center
        # A node stands for its cell, in which the variance is a twelfth of its square.
        finer = torch.linalg.cholesky(spread.mT @ (wide[:, None] * spread) + scale @ scale.mT / 12.0)
        log_integral = float(log_weight.logsumexp(0) + scale.diagonal().log().sum())
        return Nodes(duration, pace, log_weight.softmax(0), log_integral), center, finer, power

    def _is_narrow(self, weight: Tensor) -> bool:
        """Whether too few nodes carry the weight."""
        return float(weight.square().sum()) > _FEW ** -int((self.root.diagonal() > 0.0).sum())

    def _reach(self) -> float:
        return math.sqrt(self.df * math.expm1(2.0 * _RARE / (self.df + 2.0)))
