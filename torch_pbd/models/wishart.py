"""Covariance as a Wishart process: a sum of outer products of Gaussian process vectors (Section IV-A)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp import LatentGP
from torch_pbd.models.conditional import MeanAndCovariance, Shapes, beside_prior, blank, latent_skeleton, size_of


def wishart_root(
    deviation: Float[Tensor, "n b"],
    prior_root: Float[Tensor, "*m d df"],
    scale_matrix_tril: Float[Tensor, "d d"] | None = None,
) -> Float[Tensor, "n d df"]:
    """Root of eq. (8): its columns are L u_i(x), i = 1..df; L is the unit matrix where it is not given.

    ``deviation`` holds the df vectors' deviations from their prior means one after the other.
    """
    n_outputs, df = prior_root.shape[-2:]
    vectors = deviation.reshape(len(deviation), df, n_outputs).mT
    return prior_root + (vectors if scale_matrix_tril is None else scale_matrix_tril.tril() @ vectors)


def padded(prior_tril: Float[Tensor, "*m d d"], df: int) -> Float[Tensor, "*m d df"]:
    """Root of full rank for the prior means: the factor's columns, then zeros.

    The mean of all df vectors set to one number, as in the paper's example, has rank one.
    """
    shape = (*prior_tril.shape[:-1], df - prior_tril.shape[-1])
    return torch.cat([prior_tril, prior_tril.new_zeros(shape)], dim=-1)


@dataclass(frozen=True)
class WishartLink:
    """Root of the covariance as a function of the latent deviations, L held at I, and its derivatives."""

    prior_root: Float[Tensor, "*n d df"]

    largest_block: ClassVar[int] = 600
    """Whitened values to solve for together: a step costs the cube of it, and tens of them may be taken."""

    def root(self, deviation: Float[Tensor, "n b"]) -> Float[Tensor, "n d df"]:
        """Roots whose columns are the vectors."""
        return wishart_root(deviation, self.prior_root)

    def vjp(self, root: Float[Tensor, "n d df"], gradient: Float[Tensor, "n d df"]) -> Float[Tensor, "n b"]:
        """Gradient in the deviations, from that in the root."""
        return gradient.mT.flatten(1)

    def block_size(self, n_processes: int) -> int:
        """Processes in the only block of the information: all."""
        return n_processes

    def information(
        self, root: Float[Tensor, "n d df"], inverse: Float[Tensor, "n d d"]
    ) -> Iterator[tuple[Int64[Tensor, " b"], Float[Tensor, "n b b"]]]:
        """Expected Fisher information of one row, in one block: indices of the processes, and the block.

        With D = S + S', S = C^-1 dU (C^-1 U)', it is 1/2 tr(D D) = tr(S' S) + tr(S S). ``inverse`` is that of C.
        """
        # Entry i of vector j, against entry k of vector l.
        whitened = inverse @ root
        cross = whitened.mT @ inverse
        block = _block("njl,nik->njilk", whitened.mT @ whitened, inverse.mT @ inverse)
        yield self._members(root), block + _block("njk,nli->njilk", cross, cross)

    def observed_information(
        self,
        root: Float[Tensor, "n d df"],
        inverse: Float[Tensor, "n d d"],
        scatter: Float[Tensor, "n d d"],
        counts: Float[Tensor, "n 1 1"],
    ) -> Float[Tensor, "n b b"]:
        """Second derivatives of the negative log likelihood of all rows; its expectation is the information.

        They are tr((Z - n/2) D D) + tr((n - Z) B B'), B = C^-1 dU, where ``scatter`` is Z = C^-1 (sum w w') C^-T.
        """
        identity = torch.eye(root.shape[1]).to(root)
        whitened, weight = inverse @ root, scatter - 0.5 * counts * identity
        cross, weighted = whitened.mT @ inverse, whitened.mT @ weight @ inverse
        square = _block("nki,njl->njilk", inverse.mT @ weight @ inverse, whitened.mT @ whitened)
        square = square + _block("nlj,nik->njilk", whitened.mT @ weight @ whitened, inverse.mT @ inverse)
        half = 0.5 * square + _block("nli,njk->njilk", weighted, cross)
        bend = inverse.mT @ (counts * identity - scatter) @ inverse
        each = torch.eye(root.shape[2]).to(root).expand(len(root), -1, -1)
        return half + half.mT + _block("njl,nik->njilk", each, bend)

    def jacobian(
        self, root: Float[Tensor, "n d df"], scale_tril: Float[Tensor, "n d d"], inverse: Float[Tensor, "n d d"]
    ) -> Iterator[tuple[Int64[Tensor, " b"], Float[Tensor, "n b d d"]]]:
        """Derivatives of ``scale_tril`` in the deviations: C tril(D), half of D's diagonal, D as above."""
        # For entry i of vector j it is S = C^-1 e_i (C^-1 U e_j)'.
        half = torch.einsum("nai,nbj->njiab", inverse, inverse @ root).flatten(1, 2)
        lower = torch.ones_like(inverse[0]).tril() - 0.5 * torch.eye(root.shape[1]).to(root)
        yield self._members(root), scale_tril.unsqueeze(1) @ ((half + half.mT) * lower)

    def _members(self, root: Tensor) -> Tensor:
        return torch.arange(root[0].numel(), device=root.device)


def _block(equation: str, left: Tensor, right: Tensor) -> Tensor:
    """Products of pairs of processes, those of vector j one after the other, as a matrix at each input."""
    return torch.einsum(equation, left, right).flatten(3, 4).flatten(1, 2)


class WishartCovariance(nn.Module):
    """A Wishart process at the mean of its latent processes: eq. (8).

    ``latent`` are the deviations of the vectors u_i from their prior means, which L, the lower factor of the scale
    matrix V, multiplies. ``prior_root`` is L times these means; its square is the covariance far from data, and stays
    so while L is trained. ``bounded`` is whether the part of the prior in the vectors is kept between nothing and the
    prior, as by :func:`beside_prior`.
    """

    prior_root: Tensor

    def __init__(
        self,
        latent: LatentGP,
        prior_root: Float[Tensor, "d df"],
        scale_matrix_tril: Float[Tensor, "d d"],
        *,
        bounded: bool = False,
    ) -> None:
        super().__init__()
        self.latent, self.bounded = latent, bounded
        self.scale_matrix_tril = nn.Parameter(scale_matrix_tril)
        self.register_buffer("prior_root", prior_root)

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d df"]:
        """Root of the covariance at x."""
        prior = self.prior_root if prior_tril is None else padded(prior_tril, self.prior_root.shape[1])
        deviation, values = self.latent.both(x)
        root = wishart_root(deviation, prior, self.scale_matrix_tril)
        return beside_prior(root, self._vectors(values), prior) if self.bounded else root

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d df"]:
        """Root with the prior taken out (Type II): zero far from data."""
        return self._vectors(self.latent.values(x))

    def _vectors(self, values: Float[Tensor, "n b"]) -> Float[Tensor, "n d df"]:
        return values.reshape(len(values), *self.prior_root.shape[::-1]).mT


class MeanAndWishart(MeanAndCovariance):
    """Core of the Wishart process approach."""

    kind = "wishart"

    @classmethod
    def skeleton(cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int) -> "MeanAndWishart":
        """Core without numbers."""
        mean = latent_skeleton(shapes, "mean", n_outputs, n_features, config["mean_kernel"])
        df = size_of(shapes, "covariance.prior_root", 1)
        latent = latent_skeleton(shapes, "covariance.latent", n_outputs * df, n_features, config["kernel"])
        parts, bounded = (blank(n_outputs, df), blank(n_outputs, n_outputs)), bool(config.get("bounded", False))
        return cls(mean, WishartCovariance(latent, *parts, bounded=bounded))
