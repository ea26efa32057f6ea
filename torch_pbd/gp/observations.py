"""Gaussian processes conditioned on observations, eq. (5) and (6), in few coordinates: merged neighbours, or nodes."""

import heapq
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.kernels import KERNELS, correlation
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky

# Numbers of nodes to try: a decomposition costs two to six times more from one to the next. Below so many inputs for
# each node nothing is gained by them.
_N_NODES, _WORTH = (32, 48, 88, 168), 1.5

SHORTEST = 0.75
"""Length scale in spacings of the inputs, below which "needles" explain each point by itself."""

_LONGEST = 0.35  # largest length scale as a share of the range: with longer ones a covariance never reached its prior
# A hole is so much of the range, and so many spacings of the other inputs. It is to hold so many length scales: a
# smooth process without noise claims to know what is two to three of them from many inputs.
_HOLE, _SPACINGS, _IN_HOLE = 0.25, 5.0, 6.0


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
    return min(0.5, max(1e-6, SHORTEST * detail))  # inputs may coincide but for rounding


def spacing(inputs: Float[Tensor, "n e"], quantile: float = 0.9) -> float:
    """Quantile over the inputs of the distance to the nearest other input: the finest detail they show."""
    if inputs.shape[1] == 1:
        gap = torch.nn.functional.pad(inputs[:, 0].sort().values.diff(), (1, 1), value=math.inf)
        nearest = torch.minimum(gap[1:], gap[:-1]).sort().values  # torch's quantile takes at most 16 million
        place = quantile * (len(nearest) - 1)
        pair = nearest[int(place) : int(place) + 2]
        return float(torch.lerp(pair[0], pair[-1], place % 1.0))
    chosen = torch.arange(0, len(inputs), max(1, len(inputs) // 1000), device=inputs.device)
    distance = torch.cdist(inputs[chosen], inputs, compute_mode="donot_use_mm_for_euclid_dist")
    distance[torch.arange(len(chosen)), chosen] = math.inf
    return float(distance.amin(1).quantile(quantile))


def longest_within(inputs: Float[Tensor, "n e"]) -> float:
    """Longest length scale, in ranges of the inputs, with which a process is back at its prior beyond them.

    In a hole among inputs on a line it is to be so too.
    """
    hole = float(inputs[:, 0].sort().values.diff().max()) if inputs.shape[1] == 1 else 0.0
    return min(_LONGEST, hole / _IN_HOLE) if hole > _HOLE and hole > _SPACINGS * spacing(inputs, 0.75) else _LONGEST


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


class Basis:
    """Coordinates r of weighted observations at n inputs, in which a process is that of m nodes.

    With W the counts, the observations ``W^1/2 y`` have the covariance ``W^1/2 C W^1/2 + ratio * I`` over the squared
    amplitude. On a line the squared exponential C is ``B C_nodes B'`` to rounding, B the polynomial interpolation
    from ``n_nodes`` Chebyshev nodes, which does not depend on the length scale. With ``W^1/2 B = Q root`` the
    coordinates ``Q' W^1/2 y`` have the covariance ``root C_nodes root' + ratio * I``, and the remainder is noise alone.
    Without ``n_nodes`` the nodes are the inputs, and the root is ``W^1/2``; or if there are more than ``max_inputs``
    the centres of their neighbourhoods: B is the membership, and the remainder what the members differ by.
    """

    root: Float[Tensor, "r m"] | None = None
    """None where it is diagonal, with the roots of the nodes' counts."""
    orthogonal: Float[Tensor, "n r"] | None = None
    """Q; None where it is the membership."""

    def __init__(self, observations: Observations, n_nodes: int | None = None, max_inputs: int | None = None) -> None:
        self.observations = replace(observations, targets=observations.targets[:0])
        self.max_inputs = max_inputs or len(observations.counts)
        if n_nodes is not None:
            nodes, interpolation = _interpolation(observations.inputs[:, 0], n_nodes)
            self.orthogonal, self.root = torch.linalg.qr(observations.counts.sqrt()[:, None] * interpolation)
            self.nodes, self.counts = nodes[:, None], torch.ones_like(nodes)
        else:
            merged = merge_observations(self.observations, self.max_inputs)
            self.nodes, self.counts = merged.inputs, merged.counts
        weight = self.counts.sqrt()
        self._weights = weight[:, None] * weight

    def project(self, targets: Float[Tensor, "b n"]) -> tuple[Float[Tensor, "b r"], Float[Tensor, " b"]]:
        """Coordinates of targets, and the squared norm of what is outside the basis."""
        weighted = targets * self.observations.counts.sqrt()
        if self.orthogonal is not None:
            inside = weighted @ self.orthogonal
            return inside, (weighted - inside @ self.orthogonal.mT).square().sum(1)
        merged = merge_observations(replace(self.observations, targets=targets), self.max_inputs)
        inside = merged.targets * self.counts.sqrt()
        return inside, (weighted.square().sum(1) - inside.square().sum(1)).clamp_min(0.0)

    def covariance(self, correlation: Float[Tensor, "*b m m"]) -> Float[Tensor, "*b r r"]:
        """Covariance of the coordinates over the squared amplitude, without noise, from the nodes' correlation."""
        return correlation * self._weights if self.root is None else self.root @ correlation @ self.root.mT

    def covariance_vjp(self, gradient: Float[Tensor, "*b r r"]) -> Float[Tensor, "*b m m"]:
        """Gradient by the correlation of the nodes, from that by the covariance."""
        return gradient * self._weights if self.root is None else self.root.mT @ gradient @ self.root


def levels_on_nodes(inputs: Float[Tensor, "n e"], kernel: str, max_inputs: int) -> list[tuple[float, int]]:
    """Shortest length scales that numbers of nodes carry to 1e-13 (fitted; within 10 %), the longest first."""
    if inputs.shape[1] > 1 or not KERNELS[kernel].on_nodes:
        return []
    extent, most = float(inputs.max() - inputs.min()), min(len(inputs), max_inputs)
    return [(extent * 4.0 / (size - 8), size) for size in _N_NODES if most >= _WORTH * size]


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


class LatentGP(nn.Module):
    """b independent Gaussian processes, conditioned on values at the same n inputs, or nodes that stand for them.

    ``weight`` times the correlations with the inputs is the mean of eq. (5), less the prior mean, and ``value_weight``
    that of the values as they are, without a prior. The noise variance is the noise ratio over the counts. ``root`` are
    the linear combinations of the values at nodes that were observed.
    """

    inputs: Tensor
    value_weight: Tensor
    length_scale: Tensor
    amplitude: Tensor
    root: Tensor | None

    def __init__(
        self,
        inputs: Float[Tensor, "n e"],
        weight: Float[Tensor, "b n"],
        value_weight: Float[Tensor, "b n"],
        hyperparameters: Hyperparameters,
        counts: Float[Tensor, " n"],
        kernel: str = "squared_exponential",
        root: Float[Tensor, "r n"] | None = None,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(weight)
        buffers = {"inputs": inputs, "value_weight": value_weight, **vars(hyperparameters), "counts": counts}
        for name, buffer in (buffers | {"root": root}).items():
            self.register_buffer(name, buffer)

    def forward(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x less the prior mean: eq. (5)."""
        return self._weighted(x, self.weight)[0]

    def values(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x of the processes of ``value_weight``, whose prior mean is zero: what data alone say."""
        return self._weighted(x, self.value_weight)[0]

    def both(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "2 m b"]:
        """Results of :meth:`forward` and :meth:`values`, by one matrix of correlations."""
        return self._weighted(x, self.weight, self.value_weight)

    def _weighted(self, x: Tensor, *weights: Tensor) -> Float[Tensor, "w m b"]:
        cross = correlation(x, self.inputs, self.length_scale, self.kernel)
        # Processes that share their length scales share the correlations.
        if len(cross) == 1:
            return (torch.stack(weights) @ cross[0].mT).mT
        return (torch.stack(weights, dim=1) @ cross.mT).permute(1, 2, 0)

    def type1(self, x: Float[Tensor, "m e"]) -> Float[Tensor, " m"]:
        """Type I uncertainty: 0 at the training inputs, 1 where only the prior speaks.

        It is the variance of eq. (6) without noise, over the squared amplitude: the average over the processes with
        their squared amplitudes for weights.
        """
        gram = correlation(self.inputs, self.inputs, self.length_scale, self.kernel)
        cross = correlation(self.inputs, x, self.length_scale, self.kernel)
        if self.root is not None:
            gram, cross = self.root @ gram @ self.root.mT, self.root @ cross
        # 1 - k' inv(K) k, by the factor of the matrix.
        factor = safe_cholesky(gram, name="the kernel matrix of the training inputs")
        whitened = torch.linalg.solve_triangular(factor, cross, upper=False)
        reduced = (1.0 - whitened.square().sum(-2)).clamp(0.0, 1.0)
        if len(reduced) == 1:
            return reduced[0]
        share = self.amplitude.square().clamp_min(torch.finfo(self.amplitude.dtype).tiny)
        return ((share / share.sum()) @ reduced).clamp(max=1.0)


def condition(
    observations: Observations,
    hyperparameters: Hyperparameters,
    kernel: str = "squared_exponential",
    values: Float[Tensor, "b n"] | None = None,
    *,
    basis: Basis | None = None,
) -> tuple[LatentGP, float]:
    """Gaussian processes conditioned on noisy observations, and the relative jitter that needed.

    ``values`` are those whose prior mean is zero, if they are others than the targets. The nodes of a ``basis`` that
    carries the processes, by default all inputs, become the inputs of the processes.
    """
    values = observations.targets if values is None else values
    basis = Basis(observations) if basis is None else basis
    targets, _ = basis.project(torch.cat([observations.targets, values]))
    gram = basis.covariance(correlation(basis.nodes, basis.nodes, hyperparameters.length_scale, kernel))
    gram = gram + hyperparameters.noise_ratio[:, None, None] * torch.eye(gram.shape[-1]).to(gram)
    factor, jitter = cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
    solved = torch.cholesky_solve(targets.reshape(2, -1, gram.shape[-1]).permute(1, 2, 0), factor)
    # The weights of the correlations with the nodes are root' times what is solved for.
    if basis.root is None:
        root, solved = None, basis.counts.sqrt()[:, None] * solved
    else:
        root, solved = basis.root.clone(memory_format=torch.contiguous_format), basis.root.mT @ solved
    weight, value_weight = (part.contiguous() for part in solved.unbind(-1))
    nodes, counts = basis.nodes.clone(), basis.counts.clone()
    return LatentGP(nodes, weight, value_weight, hyperparameters, counts, kernel, root), jitter
