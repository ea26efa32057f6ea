"""Observations of processes, distances between their inputs, and merging of neighbours where there are too many."""

import heapq
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_SHORTEST = 0.75  # spacings of the inputs: shorter "needles" explain each point by itself


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
    counts = observations.counts.new_zeros(int(index.max()) + 1).index_add_(0, index, observations.counts)

    def mean(values: Tensor) -> Tensor:
        total = values.new_zeros(len(counts), values.shape[1])
        return total.index_add_(0, index, values * observations.counts[:, None]) / counts[:, None]

    return Observations(mean(observations.inputs), mean(observations.targets.mT).mT.contiguous(), counts)
