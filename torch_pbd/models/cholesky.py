"""Covariance by Gaussian processes on the entries of its Cholesky factor (Section IV-D, "CD")."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp import LatentGP
from torch_pbd.linalg import tril_to_vector, vector_to_tril
from torch_pbd.models.conditional import MeanAndCovariance, Shapes, beside_prior, blank, latent_skeleton

_LARGEST_LOGARITHM = 300.0  # of a diagonal entry: its square is still a number
_LEAST_DIAGONAL = 1e-6  # in standardized units: an entry of zero has no logarithm, and the floor is of this size


def tril_deviation(
    scale_tril: Float[Tensor, "*n d d"], prior_tril: Float[Tensor, "*m d d"], *, log_diagonal: bool
) -> Float[Tensor, "*n p"]:
    """Sum that the latent processes must make of the prior's factor to give ``scale_tril``, entry by entry."""
    return tril_to_vector(_linked(scale_tril, log_diagonal) - _linked(prior_tril, log_diagonal))


def _linked(scale_tril: Tensor, log_diagonal: bool) -> Tensor:
    if not log_diagonal:
        return scale_tril
    diagonal = scale_tril.diagonal(dim1=-2, dim2=-1).clamp_min(_LEAST_DIAGONAL)
    return scale_tril.tril(-1) + torch.diag_embed(diagonal.log())


@dataclass(frozen=True)
class CholeskyLink:
    """Root of the covariance as a function of the latent deviations, eq. (13), and its derivatives."""

    prior_tril: Float[Tensor, "*n d d"]
    log_diagonal: bool
    """Whether the deviations of the diagonal are of its logarithm."""

    largest_block: ClassVar[int] = 2500
    """Whitened values to solve for together: a step costs the cube of it, and few are taken."""

    def root(self, deviation: Float[Tensor, "n p"]) -> Float[Tensor, "n d d"]:
        """Lower triangular factors: the inverse of :func:`tril_deviation`."""
        size = self.prior_tril.shape[-1]
        linked, entries = self._prior
        root = linked.expand(len(deviation), -1).index_add(1, entries, deviation)
        if self.log_diagonal:
            root[:, :: size + 1].clamp_max_(_LARGEST_LOGARITHM).exp_()
        return root.reshape(-1, size, size)

    def vjp(self, root: Float[Tensor, "n d d"], gradient: Float[Tensor, "n d d"]) -> Float[Tensor, "n p"]:
        """Gradient in the deviations, from that in the root, whose diagonal it overwrites."""
        if self.log_diagonal:
            gradient.diagonal(dim1=-2, dim2=-1).mul_(root.diagonal(dim1=-2, dim2=-1))
        return gradient.flatten(1)[:, self._prior[1]]

    @cached_property
    def _prior(self) -> tuple[Tensor, Tensor]:
        """The prior's part of the root before the exponential, row by row, and places of the processes there."""
        size = self.prior_tril.shape[-1]
        row, column = torch.tril_indices(size, size, device=self.prior_tril.device)
        linked = _linked(self.prior_tril, self.log_diagonal).reshape(-1, size * size)
        return linked, row * size + column

    def block_size(self, n_processes: int) -> int:
        """Processes in the largest block of the information: the entries of the first column."""
        return (math.isqrt(8 * n_processes + 1) - 1) // 2

    def information(
        self, root: Float[Tensor, "n d d"], inverse: Float[Tensor, "n d d"]
    ) -> Iterator[tuple[Int64[Tensor, " m"], Float[Tensor, "n m m"]]]:
        """Blocks of the expected Fisher information of one row: indices of the processes, and the block.

        With D = B + B', B = L^-1 dL, it is 1/2 tr(D D) = sum_ij B_ij^2 + sum_i B_ii^2, and column j of B is made
        of column j of dL alone: the columns of the factor know nothing of each other. ``inverse`` is of the factor
        with the floor.
        """
        size = root.shape[-1]
        diagonal = root.diagonal(dim1=-2, dim2=-1)
        # One or minus one, and less where the floor is what is left of a diagonal entry.
        share = diagonal * inverse.diagonal(dim1=-2, dim2=-1)
        for column in range(size):
            below = torch.arange(column, size, device=root.device)
            jacobian = share[:, column, None, None] * inverse[:, column:, column:]
            jacobian[:, 0] *= 2.0**0.5
            if self.log_diagonal:
                jacobian[:, :, 0] *= diagonal[:, column, None]
            yield below * (below + 1) // 2 + column, jacobian.mT @ jacobian


class CholeskyCovariance(nn.Module):
    """The lower factor of the covariance: prior factor plus p = d(d+1)/2 latent processes, eq. (13).

    ``latent`` are the deviations of the entries from the prior's, in the order of ``linalg.tril_to_vector``, those of
    the diagonal of its logarithm if ``log_diagonal``; ``bounded`` is whether the part of the prior in the entries is
    kept between nothing and the prior, as by :func:`beside_prior`.
    """

    prior_tril: Tensor

    def __init__(
        self, latent: LatentGP, prior_tril: Float[Tensor, "d d"], *, log_diagonal: bool, bounded: bool = False
    ) -> None:
        super().__init__()
        self.latent, self.log_diagonal, self.bounded = latent, log_diagonal, bounded
        self.register_buffer("prior_tril", prior_tril)

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d d"]:
        """Lower triangular root of the covariance at x."""
        prior = self.prior_tril if prior_tril is None else prior_tril
        deviation, values = self.latent.both(x)
        root = CholeskyLink(prior, self.log_diagonal).root(deviation)
        if not self.bounded:
            return root
        bounded = beside_prior(root, vector_to_tril(values), prior)
        # Of a logarithm the part of the prior is a factor, which takes nothing away.
        return bounded.tril(-1) + torch.diag_embed(root.diagonal(dim1=-2, dim2=-1)) if self.log_diagonal else bounded

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d d"]:
        """Factor with the prior taken out (Type II): zero far from data."""
        return vector_to_tril(self.latent.values(x))


class MeanAndCholesky(MeanAndCovariance):
    """Core of the Cholesky decomposition approach."""

    kind = "cholesky"

    def config(self) -> dict[str, Any]:
        """Kernels, and on what the processes act."""
        return {**super().config(), "log_diagonal": self.covariance.log_diagonal}

    @classmethod
    def skeleton(cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int) -> "MeanAndCholesky":
        """Core without numbers."""
        mean = latent_skeleton(shapes, "mean", n_outputs, n_features, config["mean_kernel"])
        n_processes = n_outputs * (n_outputs + 1) // 2
        latent = latent_skeleton(shapes, "covariance.latent", n_processes, n_features, config["kernel"])
        options = {"log_diagonal": bool(config["log_diagonal"]), "bounded": bool(config.get("bounded", False))}
        return cls(mean, CholeskyCovariance(latent, blank(n_outputs, n_outputs), **options))
