"""Observations of processes, and what a smooth kernel can tell of them: neighbours merged, or nodes for them."""

import heapq
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.kernels import KERNELS

_SHORTEST = 0.75  # spacings of the inputs: shorter "needles" explain each point by itself

_N_NODES = (32, 48, 88, 168)  # twice the cost of a decomposition, or six times, from one to the next
_WORTH = 1.5  # inputs for each node, below which nothing is gained


@dataclass(frozen=True)
class Observations:
    """Targets of b processes at n distinct inputs, the mean of ``counts`` observations each."""

    inputs: Float[Tensor, "n e"]
    targets: Float[Tensor, "b n"]
    counts: Float[Tensor, " n"]


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of b processes; one length scale where all share it."""

    length_scale: Float[Tensor, "g e"]
    amplitude: Float[Tensor, " b"]
    noise_ratio: Float[Tensor, " b"]
    """Noise variance over the squared amplitude."""


def resolved_length_scale(inputs: Float[Tensor, "n e"]) -> float:
    """Shortest length scale that the inputs, of a range of about one, tell from noise."""
    n_inputs, n_features = inputs.shape
    detail = max(spacing(inputs), n_inputs ** (-1.0 / n_features))
    return min(0.5, max(1e-6, _SHORTEST * detail))  # inputs may coincide but for rounding


def spacing(inputs: Float[Tensor, "n e"], quantile: float = 0.9) -> float:
    """Distance to the nearest other input, a quantile over the inputs; the finest detail they show."""
    if inputs.shape[1] == 1 and len(inputs) > 1:
        gap = torch.nn.functional.pad(inputs[:, 0].sort().values.diff(), (1, 1), value=float("inf"))
        nearest = torch.minimum(gap[1:], gap[:-1]).sort().values.tolist()
        place = quantile * (len(nearest) - 1)
        low, high = nearest[int(place)], nearest[min(int(place) + 1, len(nearest) - 1)]
        return float(low + (place - int(place)) * (high - low))
    chosen = torch.arange(0, len(inputs), max(1, len(inputs) // 1000), device=inputs.device)
    distance = torch.cdist(inputs[chosen], inputs, compute_mode="donot_use_mm_for_euclid_dist")
    distance[torch.arange(len(chosen)), chosen] = float("inf")
    return float(distance.amin(1).quantile(quantile))


def neighbourhoods(inputs: Float[Tensor, "n e"], max_inputs: int) -> Int64[Tensor, " n"]:
    """Index of the neighbourhood of each input; at most ``max_inputs`` of them, each for itself if they fit.

    The largest neighbourhood is split at the median of its widest dimension until there are enough, so they
    hold about equally many inputs (up to a factor of two). On a line they are runs of sorted inputs, of equal numbers
    up to one.
    """
    everything = torch.arange(len(inputs), device=inputs.device)
    if len(inputs) <= max_inputs:
        return everything
    if inputs.shape[1] == 1:
        runs = everything * max_inputs // len(inputs)
        return torch.empty_like(runs).index_copy(0, inputs[:, 0].argsort(stable=True), runs)
    groups = [(-len(inputs), "", everything)]  # the second is the way through the halves, and never equal
    for _ in range(1, max_inputs):
        _, way, group = heapq.heappop(groups)
        members = inputs[group]
        widest = (members.amax(0) - members.amin(0)).argmax()
        low, high = group[members[:, widest].argsort(stable=True)].tensor_split(2)
        heapq.heappush(groups, (-len(low), way + "0", low))
        heapq.heappush(groups, (-len(high), way + "1", high))
    index = torch.empty_like(everything)
    for number, (_, _, group) in enumerate(sorted(groups, key=lambda entry: entry[1])):
        index[group] = number
    return index


def merge_observations(observations: Observations, max_inputs: int) -> Observations:
    """At most ``max_inputs`` observations: neighbours become their mean, with their counts added up.

    Exact where the process is straight across a neighbourhood. The cost of everything that follows is
    bounded: cubic in ``max_inputs``, linear in the observations.
    """
    if len(observations.counts) <= max_inputs:
        return observations
    index = neighbourhoods(observations.inputs, max_inputs)
    weights = observations.counts[:, None]
    counts = sum_by(weights, index)
    inputs, targets = (
        sum_by(part * weights, index) / counts for part in (observations.inputs, observations.targets.mT)
    )
    return Observations(inputs, targets.mT.contiguous(), counts[:, 0])


def sum_by(values: Float[Tensor, "n d"], index: Int64[Tensor, " n"], n_groups: int | None = None) -> Tensor:
    """Sums (m, d) of the rows of each group; of as many groups as the index says, or more."""
    n_groups = int(index.max()) + 1 if n_groups is None else n_groups
    return values.new_zeros(n_groups, values.shape[1]).index_add_(0, index, values)


class Resolution(NamedTuple):
    """How finely observations are looked at."""

    n_nodes: int | None
    """Chebyshev nodes; by None the inputs, or the centres of their neighbourhoods."""
    max_inputs: int | None
    """Largest number of neighbourhoods; by None each input is for itself."""
    shortest_length_scale: float
    """Shortest length scale that it carries."""


FULL = Resolution(None, None, 0.0)
"""All inputs."""


def resolutions(
    observations: Observations, kernel: str, *, noisy: bool, max_inputs: int | None = None
) -> list[Resolution]:
    """Resolutions to try, the coarsest first; what nodes do not carry is treated as noise, so there must be some."""
    n_inputs, n_features = observations.inputs.shape
    finest = FULL
    if noisy and max_inputs is not None and n_inputs > max_inputs:
        centres = merge_observations(replace(observations, targets=observations.targets[:0]), max_inputs).inputs
        finest = Resolution(None, max_inputs, resolved_length_scale(centres))
    if not noisy or n_features > 1 or not KERNELS[kernel].on_nodes:
        return [finest]
    extent = float(observations.inputs.max() - observations.inputs.min())
    sizes = [size for size in _N_NODES if min(n_inputs, max_inputs or n_inputs) >= _WORTH * size]
    # Interpolation is exact to 1e-13 down to this length scale (fitted; within 10 %).
    return [*(Resolution(size, None, extent * 4.0 / (size - 8)) for size in sizes), finest]


class Basis:
    """Coordinates r of weighted observations at n inputs, in which a process is that of m nodes.

    With W the counts, the observations ``W^1/2 y`` have the covariance ``W^1/2 C W^1/2 + ratio * I`` over the squared
    amplitude. On a line the squared exponential C is ``B C_nodes B'`` to rounding, B the polynomial interpolation
    from Chebyshev nodes, which does not depend on the length scale. With ``W^1/2 B = Q root`` the coordinates
    ``Q' W^1/2 y`` have the covariance ``root C_nodes root' + ratio * I``, and the remainder is noise alone.
    Where the nodes are the inputs the root is ``W^1/2``; where they are centres of neighbourhoods B is the
    membership, and the remainder what the members differ by.

    Parameters
    ----------
    observations : Observations
        Whose inputs and counts count; the targets do not.
    resolution : Resolution
    """

    root: Float[Tensor, "r m"] | None = None
    """None where it is diagonal, with the roots of the nodes' counts."""
    orthogonal: Float[Tensor, "n r"] | None = None
    """Q; None where it is the membership."""

    def __init__(self, observations: Observations, resolution: Resolution) -> None:
        self.observations = replace(observations, targets=observations.targets[:0])
        self.resolution = resolution
        if resolution.n_nodes is not None:
            nodes, interpolation = _interpolation(observations.inputs[:, 0], resolution.n_nodes)
            self.orthogonal, self.root = torch.linalg.qr(observations.counts.sqrt()[:, None] * interpolation)
            self.nodes, self.counts = nodes[:, None], torch.ones_like(nodes)
        else:
            merged = merge_observations(self.observations, resolution.max_inputs or len(observations.counts))
            self.nodes, self.counts = merged.inputs, merged.counts

    def project(self, targets: Float[Tensor, "b n"]) -> tuple[Float[Tensor, "b r"], Float[Tensor, " b"]]:
        """Coordinates of targets, and the squared norm of what is outside the basis."""
        weighted = targets * self.observations.counts.sqrt()
        if self.orthogonal is not None:
            inside = weighted @ self.orthogonal
            return inside, (weighted - inside @ self.orthogonal.mT).square().sum(1)
        if self.resolution.max_inputs is None:
            return weighted, torch.zeros_like(weighted[:, 0])
        merged = merge_observations(replace(self.observations, targets=targets), self.resolution.max_inputs)
        inside = merged.targets * self.counts.sqrt()
        return inside, (weighted.square().sum(1) - inside.square().sum(1)).clamp_min(0.0)

    def covariance(self, correlation: Float[Tensor, "*b m m"]) -> Float[Tensor, "*b r r"]:
        """Covariance of the coordinates over the squared amplitude, without noise, from the nodes' correlation."""
        if self.root is not None:
            return self.root @ correlation @ self.root.mT
        return correlation * self._weights

    def covariance_vjp(self, gradient: Float[Tensor, "*b r r"]) -> Float[Tensor, "*b m m"]:
        """``root' gradient root``: gradient by the correlation of the nodes, from that by the covariance."""
        if self.root is not None:
            return self.root.mT @ gradient @ self.root
        return gradient * self._weights

    def node_weights(self, values: Float[Tensor, "*b r q"]) -> Float[Tensor, "*b m q"]:
        """``root' values``: weights of the correlations with the nodes."""
        return self.root.mT @ values if self.root is not None else self.counts.sqrt()[:, None] * values

    @cached_property
    def _weights(self) -> Float[Tensor, "m m"]:
        weight = self.counts.sqrt()
        return weight[:, None] * weight


def _interpolation(x: Float[Tensor, " n"], n_nodes: int) -> tuple[Tensor, Tensor]:
    """Chebyshev nodes over the range of x, and the barycentric interpolation (n, m) from them."""
    low, high = x.min(), x.max()
    angle = (torch.arange(n_nodes).to(x) + 0.5) * (math.pi / n_nodes)
    nodes = 0.5 * (low + high) + 0.5 * (high - low) * torch.cos(angle)
    sign = 1.0 - 2.0 * (torch.arange(n_nodes) % 2).to(x)
    difference = x[:, None] - nodes
    hit = difference == 0
    terms = sign * torch.sin(angle) / torch.where(hit, 1.0, difference)
    matrix = terms / terms.sum(1, keepdim=True)
    return nodes, torch.where(hit.any(1, keepdim=True), hit.to(x), matrix)
