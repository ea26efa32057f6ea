"""Observations brought down to what a smooth kernel can tell of them: cost no longer depends on their number."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.neighbourhoods import merge_observations, resolved_length_scale
from torch_pbd.gp.observations import Observations
from torch_pbd.kernels import KERNELS

_N_NODES = (32, 48, 88, 168)
_WORTH = 1.5  # inputs for each node, below which nothing is gained
_LEAST_NOISE_RATIO = 0.999e-10  # what the nodes cannot tell is treated as noise, so there must be some


@dataclass(frozen=True)
class Resolution:
    """How finely observations are looked at."""

    n_nodes: int | None
    """Chebyshev nodes; by None the inputs, or the centres of their neighbourhoods."""
    max_inputs: int | None
    """Of the neighbourhoods."""
    shortest_length_scale: float
    """What it carries."""


FULL = Resolution(None, None, 0.0)
"""All inputs."""


def resolutions(
    observations: Observations, kernel: str, *, noisy: bool, max_inputs: int | None = None
) -> list[Resolution]:
    """Those to try, the coarsest first."""
    n_inputs, n_features = observations.inputs.shape
    finest = FULL
    if noisy and max_inputs is not None and n_inputs > max_inputs:
        centres = merge_observations(replace(observations, targets=observations.targets[:0]), max_inputs).inputs
        finest = Resolution(None, max_inputs, resolved_length_scale(centres))
    if not noisy or n_features > 1 or not KERNELS[kernel].on_nodes:
        return [finest]
    extent = float(observations.inputs.max() - observations.inputs.min())
    sizes = [size for size in _N_NODES if min(n_inputs, max_inputs or n_inputs) >= _WORTH * size]
    return [*(Resolution(size, None, extent * _shortest(size)) for size in sizes), finest]


@dataclass(frozen=True)
class Basis:
    """Coordinates r of weighted observations at n inputs, in which what a process says of them is told by m nodes.

    With W the counts, the observations ``W^1/2 y`` have the covariance ``W^1/2 C W^1/2 + ratio * I`` over the squared
    amplitude. On a line the squared exponential C is ``B C_nodes B'`` to rounding, B the polynomial interpolation
    from Chebyshev nodes, which does not depend on the length scale. With ``W^1/2 B = Q root`` the coordinates
    ``Q' W^1/2 y`` have the covariance ``root C_nodes root' + ratio * I``, and the remainder is noise alone.
    Where the nodes are the inputs the root is ``W^1/2``; where they are centres of neighbourhoods B is the
    membership, and the remainder what the members differ by.
    """

    nodes: Float[Tensor, "m e"]
    counts: Float[Tensor, " m"]
    """Square of the root's diagonal, where it is diagonal; else ones."""
    root: Float[Tensor, "r m"] | None
    orthogonal: Float[Tensor, "n r"] | None
    """Q; None where it is the membership."""
    observations: Observations
    """Whose inputs and counts these are; without targets."""
    resolution: Resolution

    @classmethod
    def of(cls, observations: Observations, resolution: Resolution) -> "Basis":
        """Basis of the inputs and counts of observations."""
        bare = replace(observations, targets=observations.targets[:0])
        if resolution.n_nodes is None:
            merged = bare if resolution.max_inputs is None else merge_observations(bare, resolution.max_inputs)
            return cls(merged.inputs, merged.counts, None, None, bare, resolution)
        nodes, interpolation = _interpolation(observations.inputs[:, 0], resolution.n_nodes)
        orthogonal, root = torch.linalg.qr(observations.counts.sqrt()[:, None] * interpolation)
        return cls(nodes[:, None], torch.ones_like(nodes), root, orthogonal, bare, resolution)

    def project(self, targets: Float[Tensor, "b n"]) -> "Projection":
        """Coordinates of targets."""
        data = self.observations
        weighted = targets * data.counts.sqrt()
        if self.orthogonal is not None:
            inside = weighted @ self.orthogonal
            remainder = (weighted - inside @ self.orthogonal.mT).square().sum(1)
        elif self.resolution.max_inputs is not None:
            inside = merge_observations(replace(data, targets=targets), self.resolution.max_inputs).targets
            inside = inside * self.counts.sqrt()
            remainder = (weighted.square().sum(1) - inside.square().sum(1)).clamp_min(0.0)
        else:
            inside, remainder = weighted, torch.zeros_like(weighted[:, 0])
        return Projection(self, inside, remainder, weighted, len(data.counts), float(data.counts.log().sum()))

    def covariance(self, correlation: Float[Tensor, "*b m m"]) -> Float[Tensor, "*b r r"]:
        """Of the coordinates over the squared amplitude, without noise, from the correlation of the nodes."""
        if self.root is not None:
            return self.root @ correlation @ self.root.mT
        return correlation * self._weights

    @cached_property
    def _weights(self) -> Float[Tensor, "m m"]:
        """Of the entries of a covariance, where the root is diagonal."""
        weight = self.counts.sqrt()
        return weight[:, None] * weight

    def pulled_back(self, matrix: Float[Tensor, "*b r r"]) -> Float[Tensor, "*b m m"]:
        """``root' matrix root``: the gradient by the correlation of the nodes, given that by the covariance."""
        if self.root is not None:
            return self.root.mT @ matrix @ self.root
        return self.covariance(matrix)

    def lowered(self, values: Float[Tensor, "*b r q"]) -> Float[Tensor, "*b m q"]:
        """``root' values``: weights of the correlations with the nodes."""
        return self.root.mT @ values if self.root is not None else self.counts.sqrt()[:, None] * values


@dataclass(frozen=True)
class Projection:
    """Observations of b processes in the coordinates of a basis."""

    basis: Basis
    targets: Float[Tensor, "b r"]
    remainder: Float[Tensor, " b"]
    """Squared norm of what is outside the basis."""
    weighted: Float[Tensor, "b n"]
    """The observations times the roots of their counts."""
    n_inputs: int
    sum_log_counts: float

    @property
    def n_outside(self) -> int:
        """Dimensions that are noise alone."""
        return self.n_inputs - self.targets.shape[1]


def basis_for(observations: Observations, length_scale: Tensor, noise_ratio: Tensor, kernel: str) -> Basis:
    """The coarsest basis that carries the length scales."""
    noisy = bool((noise_ratio >= _LEAST_NOISE_RATIO).all())
    levels = resolutions(observations, kernel, noisy=noisy)
    shortest = 1.0001 * float(length_scale.min())  # a search ends at the bound but for rounding
    level = next((level for level in levels if shortest >= level.shortest_length_scale), levels[-1])
    return Basis.of(observations, level)


def _shortest(n_nodes: int) -> float:
    """Length scale, of a range of one, down to which interpolation is exact to 1e-13 (fitted; within 10 %)."""
    return 4.0 / (n_nodes - 8)


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
