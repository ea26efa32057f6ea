"""Covariances as functions of latent processes: entries of a Cholesky factor ("CD"), or a Wishart process ("WP")."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import scale_tril_from_root, tril_to_vector, vector_to_tril
from torch_pbd.models import with_floor

_LARGEST_LOGARITHM = 300.0  # largest logarithm of a diagonal entry whose square float64 holds
_LEAST_DIAGONAL = 1e-6  # in standardized units: an entry of zero has no logarithm, and the floor is of this size
_LOG_AMPLITUDE = 2.0  # prior standard deviation of the logarithm of an entry: a factor of e^2 either way is usual

Blocks = Iterator[tuple[Int64[Tensor, " m"], Float[Tensor, "n m ..."]]]
"""Indices of some processes, and matrices of their deviations at each input."""


class Covariances:
    """Covariances by a root without the floor, their factors C with it, and the rows: scatter and counts (n, 1, 1)."""

    def __init__(self, root: Float[Tensor, "n d r"], scatter_root: Tensor, counts: Tensor) -> None:
        self.root, self.scale_tril = root, scale_tril_from_root(with_floor(root))
        self._scatter_root, self.counts = scatter_root, counts

    @cached_property
    def inverse(self) -> Float[Tensor, "n d d"]:
        """Inverse of C."""
        return torch.linalg.inv(self.scale_tril).tril()

    @cached_property
    def scatter(self) -> Float[Tensor, "n d d"]:
        """Whitened scatter Z = C^-1 (sum w w') C^-T."""
        whitened = self.inverse @ self._scatter_root
        return whitened @ whitened.mT

    @property
    def expected_scatter(self) -> Float[Tensor, "n d d"]:
        """Expectation of Z: the unit matrix for each row."""
        return self.counts * torch.eye(self.root.shape[1]).to(self.root)


@dataclass(frozen=True)
class Link(ABC):
    """Root of the covariance as a function of the deviations of latent processes from a prior's, and its derivatives.

    The root is that of the prior plus the deviations, as matrices, times L: the lower factor of the scale matrix of a
    Wishart process, and the unit matrix where it is not given, as all but :meth:`root` assume. With ``log_diagonal``
    the deviations of the diagonal are of its logarithm.
    """

    prior: Float[Tensor, "*n d r"]
    log_diagonal: bool = False
    scale_matrix_tril: Float[Tensor, "d d"] | None = None

    largest_block: ClassVar[int]
    """Whitened values to solve for together: a step costs the cube of it."""
    largest_share: ClassVar[float] = 0.0
    """Largest share of the observed information in a step of the training."""

    @abstractmethod
    def flatten(self, matrix: Float[Tensor, "*n d r"]) -> Float[Tensor, "*n b"]:
        """Entries of matrices in the order of the processes."""

    @abstractmethod
    def unflatten(self, values: Float[Tensor, "*n b"]) -> Float[Tensor, "*n d r"]:
        """Matrices of values of the processes."""

    @property
    @abstractmethod
    def block_size(self) -> int:
        """Processes in the largest block of the information."""

    @abstractmethod
    def information(self, point: Covariances) -> Blocks:
        """Blocks of the expected Fisher information of one row."""

    def observed_information(self, point: Covariances) -> Float[Tensor, "n b b"]:
        """Second derivatives of the negative log likelihood of all rows, of a link that takes a share of them."""
        raise NotImplementedError

    def far(self) -> "Link":
        """Link of one prior: any of a callable one, which is handed in at every prediction."""
        return replace(self, prior=self.prior.reshape(-1, *self.prior.shape[-2:])[0])

    def root(self, deviation: Float[Tensor, "n b"]) -> Float[Tensor, "n d r"]:
        """Root at each input."""
        beside = self.unflatten(deviation)
        beside = beside if self.scale_matrix_tril is None else self.scale_matrix_tril.tril() @ beside
        root = self._linked(self.prior) + beside
        if self.log_diagonal:
            diagonal = root.diagonal(dim1=-2, dim2=-1).clamp_max_(_LARGEST_LOGARITHM)
            diagonal.copy_(diagonal.contiguous().exp())  # with gaps between the numbers it takes four times as long
        return root

    def deviation(self, root: Float[Tensor, "*n d r"]) -> Float[Tensor, "*m b"]:
        """Deviations that give this root."""
        return self.flatten(self._linked(root) - self._linked(self.prior))

    def bounded(self, both: Float[Tensor, "2 n b"]) -> Float[Tensor, "n d r"]:
        """Root of deviations, whose part beside values without a prior is kept between nothing and the prior.

        It is the prior times one less an interpolation of ones, which swings to 1.14 between two inputs: of a prior far
        above the values, as of a movement of many standard deviations, it would take more away than there is.
        """
        root, alone = self.root(both[0]), self.unflatten(both[1])
        bounded = alone + (root - alone).clamp(self.prior.clamp_max(0.0), self.prior.clamp_min(0.0))
        if self.log_diagonal:  # the prior is a factor of an entry whose logarithm deviates, and takes nothing away
            bounded.diagonal(dim1=-2, dim2=-1).copy_(root.diagonal(dim1=-2, dim2=-1))
        return bounded

    def amplitude(self) -> Float[Tensor, " b"]:
        """Prior deviation of each process: that of its output, which is the length of the row of the prior."""
        size, rank = self.prior.shape[-2:]
        rows = self.prior.reshape(-1, size, rank).square().sum(-1).mean(0).sqrt()
        matrix = rows[:, None].repeat(1, rank)
        return self.flatten(matrix.fill_diagonal_(_LOG_AMPLITUDE) if self.log_diagonal else matrix)

    def vjp(self, root: Float[Tensor, "n d r"], gradient: Float[Tensor, "n d r"]) -> Float[Tensor, "n b"]:
        """Gradient in the deviations, from that in the root, whose diagonal it overwrites."""
        if self.log_diagonal:
            gradient.diagonal(dim1=-2, dim2=-1).mul_(root.diagonal(dim1=-2, dim2=-1))
        return self.flatten(gradient)

    def _linked(self, root: Tensor) -> Tensor:
        if not self.log_diagonal:
            return root
        linked = root.clone()
        linked.diagonal(dim1=-2, dim2=-1).clamp_min_(_LEAST_DIAGONAL).log_()
        return linked


class CholeskyLink(Link):
    """The lower factor by processes on its d(d+1)/2 entries, eq. (13)."""

    largest_block = 2500  # few steps are taken

    def flatten(self, matrix: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n b"]:
        """Lower triangle row by row."""
        return tril_to_vector(matrix)

    def unflatten(self, values: Float[Tensor, "*n b"]) -> Float[Tensor, "*n d d"]:
        """Lower triangular matrices."""
        return vector_to_tril(values)

    @property
    def block_size(self) -> int:
        """Entries of the first column."""
        return self.prior.shape[-1]

    def information(self, point: Covariances) -> Blocks:
        """Blocks of the expected Fisher information of one row, one for each column of the factor L.

        With D = B + B', B = L^-1 dL, it is 1/2 tr(D D) = sum_ij B_ij^2 + sum_i B_ii^2, and column j of B is made
        of column j of dL alone: the columns of the factor know nothing of each other.
        """
        inverse, size = point.inverse, self.block_size
        diagonal = point.root.diagonal(dim1=-2, dim2=-1)
        # One or minus one, and less where the floor is what is left of a diagonal entry.
        share = diagonal * inverse.diagonal(dim1=-2, dim2=-1)
        for column in range(size):
            below = torch.arange(column, size, device=inverse.device)
            jacobian = share[:, column, None, None] * inverse[:, column:, column:]
            jacobian[:, 0] *= 2.0**0.5
            if self.log_diagonal:
                jacobian[:, :, 0] *= diagonal[:, column, None]
            yield below * (below + 1) // 2 + column, jacobian.mT @ jacobian


class WishartLink(Link):
    """The columns L u_i, i = 1..df, by processes on the entries of the vectors, eq. (8), one after the other."""

    largest_block, largest_share = 600, 1.0  # tens of steps may be taken

    def flatten(self, matrix: Float[Tensor, "*n d df"]) -> Float[Tensor, "*n b"]:
        """Columns one after the other."""
        return matrix.mT.flatten(-2)

    def unflatten(self, values: Float[Tensor, "*n b"]) -> Float[Tensor, "*n d df"]:
        """Matrices whose columns are the vectors."""
        return values.reshape(*values.shape[:-1], *self.prior.shape[:-3:-1]).mT

    @property
    def block_size(self) -> int:
        """All processes."""
        return self.prior.shape[-2] * self.prior.shape[-1]

    def information(self, point: Covariances) -> Blocks:
        """Expected Fisher information of one row, in one block.

        With D = S + S', S = C^-1 dU (C^-1 U)', it is 1/2 tr(D D) = tr(S' S) + tr(S S).
        """
        # Entry i of vector j, against entry k of vector l.
        inverse = point.inverse
        whitened = inverse @ point.root
        cross = whitened.mT @ inverse
        block = _block("njl,nik->njilk", whitened.mT @ whitened, inverse.mT @ inverse)
        yield torch.arange(self.block_size, device=inverse.device), block + _block("njk,nli->njilk", cross, cross)

    def observed_information(self, point: Covariances) -> Float[Tensor, "n b b"]:
        """Second derivatives of all rows, tr((Z - n/2) D D) + tr((n - Z) B B'), B = C^-1 dU."""
        inverse, expected = point.inverse, point.expected_scatter
        whitened, weight = inverse @ point.root, point.scatter - 0.5 * expected
        cross, weighted = whitened.mT @ inverse, whitened.mT @ weight @ inverse
        square = _block("nki,njl->njilk", inverse.mT @ weight @ inverse, whitened.mT @ whitened)
        square = square + _block("nlj,nik->njilk", whitened.mT @ weight @ whitened, inverse.mT @ inverse)
        half = 0.5 * square + _block("nli,njk->njilk", weighted, cross)
        bend = inverse.mT @ (expected - point.scatter) @ inverse
        each = torch.eye(whitened.shape[2]).to(whitened).expand(len(whitened), -1, -1)
        return half + half.mT + _block("njl,nik->njilk", each, bend)


def _block(equation: str, left: Tensor, right: Tensor) -> Tensor:
    """Products of pairs of processes, those of vector j one after the other, as a matrix at each input."""
    return torch.einsum(equation, left, right).flatten(3, 4).flatten(1, 2)


def padded(prior_tril: Float[Tensor, "*m d d"], df: int) -> Float[Tensor, "*m d df"]:
    """Root of full rank for the prior means of df vectors: the factor's columns, then zeros.

    The mean of all df vectors set to one number, as in the paper's example, has rank one.
    """
    shape = (*prior_tril.shape[:-1], df - prior_tril.shape[-1])
    return torch.cat([prior_tril, prior_tril.new_zeros(shape)], dim=-1)
