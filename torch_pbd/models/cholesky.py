"""Covariance by Gaussian processes on the entries of its Cholesky factor (Section IV-D, "CD")."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp import LatentGP
from torch_pbd.linalg import tril_to_vector, vector_to_tril


def tril_deviation(
    scale_tril: Float[Tensor, "*n d d"], prior_tril: Float[Tensor, "*m d d"], *, log_diagonal: bool
) -> Float[Tensor, "*n p"]:
    """What the latent processes must add to the prior's factor to give ``scale_tril``."""
    return tril_to_vector(_linked(scale_tril, log_diagonal) - _linked(prior_tril, log_diagonal))


def deviation_tril(
    deviation: Float[Tensor, "n p"], prior_tril: Float[Tensor, "*m d d"], *, log_diagonal: bool
) -> Float[Tensor, "n d d"]:
    """Inverse of :func:`tril_deviation`."""
    linked = _linked(prior_tril, log_diagonal) + vector_to_tril(deviation)
    if not log_diagonal:
        return linked
    diagonal = linked.diagonal(dim1=-2, dim2=-1).clamp_max(300.0)
    return linked.tril(-1) + torch.diag_embed(diagonal.exp())


def _linked(scale_tril: Tensor, log_diagonal: bool) -> Tensor:
    if not log_diagonal:
        return scale_tril
    diagonal = scale_tril.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6)
    return scale_tril.tril(-1) + torch.diag_embed(diagonal.log())


class CholeskyCovariance(nn.Module):
    """The lower factor of the covariance: prior factor plus p = d(d+1)/2 latent processes, eq. (13).

    Parameters
    ----------
    latent : LatentGP
        Deviations of the entries from the prior's, in the order of ``linalg.tril_to_vector``.
    prior_tril : Tensor of shape (d, d)
        Factor of the covariance far from data.
    log_diagonal : bool
        Whether the processes of the diagonal act on its logarithm.
    """

    prior_tril: Tensor

    def __init__(self, latent: LatentGP, prior_tril: Float[Tensor, "d d"], *, log_diagonal: bool) -> None:
        super().__init__()
        self.latent = latent
        self.log_diagonal = log_diagonal
        self.register_buffer("prior_tril", prior_tril)

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d d"]:
        """Lower triangular root of the covariance at x."""
        prior = self.prior_tril if prior_tril is None else prior_tril
        return deviation_tril(self.latent(x), prior, log_diagonal=self.log_diagonal)

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out (Type II): zero far from data."""
        return vector_to_tril(self.latent.values(x))
