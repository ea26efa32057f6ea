"""Covariance as a Wishart process: a sum of outer products of Gaussian process vectors (Section IV-A)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp import LatentGP


def wishart_root(
    deviation: Float[Tensor, "n b"],
    prior_root: Float[Tensor, "*m d df"],
    scale_matrix_tril: Float[Tensor, "d d"],
) -> Float[Tensor, "n d df"]:
    """Root of eq. (8): its columns are L u_i(x), i = 1..df.

    ``deviation`` holds the df vectors' deviations from their prior means one after the other.
    """
    n_outputs, df = prior_root.shape[-2:]
    vectors = deviation.reshape(len(deviation), df, n_outputs).mT
    return prior_root + scale_matrix_tril.tril() @ vectors


def padded(prior_tril: Float[Tensor, "*m d d"], df: int) -> Float[Tensor, "*m d df"]:
    """Root of full rank for the prior means: the factor's columns, then zeros.

    The mean of all df vectors set to one number, as in the paper's example, has rank one.
    """
    shape = (*prior_tril.shape[:-1], df - prior_tril.shape[-1])
    return torch.cat([prior_tril, prior_tril.new_zeros(shape)], dim=-1)


class WishartCovariance(nn.Module):
    """A Wishart process at the mean of its latent processes: eq. (8).

    Parameters
    ----------
    latent : LatentGP
        df * d processes: deviations of the vectors u_i from their prior means.
    prior_root : Tensor of shape (d, df)
        L times the prior means of the vectors; its square is the covariance far from data, and stays so while
        L is trained: L multiplies the deviations.
    scale_matrix_tril : Tensor of shape (d, d)
        The paper's L, lower factor of the scale matrix V.
    """

    prior_root: Tensor

    def __init__(
        self, latent: LatentGP, prior_root: Float[Tensor, "d df"], scale_matrix_tril: Float[Tensor, "d d"]
    ) -> None:
        super().__init__()
        self.latent = latent
        self.scale_matrix_tril = nn.Parameter(scale_matrix_tril)
        self.register_buffer("prior_root", prior_root)

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d df"]:
        """Root of the covariance at x."""
        df = self.prior_root.shape[1]
        prior = self.prior_root if prior_tril is None else padded(prior_tril, df)
        return wishart_root(self.latent(x), prior, self.scale_matrix_tril)

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out (Type II): zero far from data."""
        n_outputs, df = self.prior_root.shape
        return self.latent.values(x).reshape(len(x), df, n_outputs).mT
