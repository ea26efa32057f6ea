"""Joint normal law of a whole movement: a correlation along time, times the outputs, plus a few loadings."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize


@dataclass(frozen=True)
class JointNormal:
    """Normal law of n steps of d outputs whose covariance is never formed unless it is asked for.

    A movement is ``x_t = mean_t + A_t (g_t + U_t c)``: g has the correlation R over the steps, independently in each
    output, and c is standard normal. Its covariance is ``A (R kron I + U U') A' - V V'``, with A block diagonal; V is
    what observations of single entries have taken off. Costs grow with n^3 + n^2 d + n d (k + p)^2.
    """

    mean: Float[Tensor, "n d"]
    factor: Float[Tensor, "n d d"]
    """A, one block a step."""
    correlation: Float[Tensor, "n n"]
    """R, positive semidefinite."""
    loadings: Float[Tensor, "n d k"]
    """U."""
    explained: Float[Tensor, "n d p"]
    """V."""

    def at(self, steps: Int[Tensor, " m"]) -> "JointNormal":
        """Law of some of the steps."""
        return JointNormal(
            self.mean[steps],
            self.factor[steps],
            self.correlation[steps][:, steps],
            self.loadings[steps],
            self.explained[steps],
        )

    def joined(self, other: "JointNormal", between: Float[Tensor, "n m"]) -> "JointNormal":
        """Law of the steps of both, which are correlated between each other."""
        upper = torch.cat([self.correlation, between], dim=1)
        return JointNormal(
            torch.cat([self.mean, other.mean]),
            torch.cat([self.factor, other.factor]),
            torch.cat([upper, torch.cat([between.mT, other.correlation], dim=1)]),
            torch.cat([self.loadings, other.loadings]),
            torch.cat([self.explained, other.explained]),
        )

    def covariance(self) -> Float[Tensor, "n d n d"]:
        """Whole covariance: n d squared numbers."""
        n, d = self.mean.shape
        inner = torch.einsum("ij,ab->iajb", self.correlation, torch.eye(d).to(self.mean))
        flat = self.loadings.reshape(n * d, -1)
        inner = inner + (flat @ flat.mT).reshape(n, d, n, d)
        explained = self.explained.reshape(n * d, -1)
        whole = torch.einsum("iab,ibjc,jdc->iajd", self.factor, inner, self.factor)
        return symmetrize(whole.reshape(n * d, n * d) - explained @ explained.mT).reshape(n, d, n, d)

    def marginal(self) -> Float[Tensor, "n d d"]:
        """Covariance of the outputs at each step."""
        inner = self.loadings @ self.loadings.mT
        inner = inner + torch.diag_embed(self.correlation.diagonal()[:, None].expand(self.mean.shape))
        outer = self.factor @ inner @ self.factor.mT - self.explained @ self.explained.mT
        return symmetrize(outer)

    def columns(self, steps: Int[Tensor, " p"], outputs: Int[Tensor, " p"]) -> Float[Tensor, "n d p"]:
        """Covariance of all steps and outputs with single entries."""
        rows = self.factor[steps, outputs]  # (p, d)
        inner = torch.einsum("np,pd->ndp", self.correlation[:, steps], rows)
        inner = inner + self.loadings @ torch.einsum("pd,pdk->kp", rows, self.loadings[steps])
        return self.factor @ inner - self.explained @ self.explained[steps, outputs].mT

    def deviations(self, correlated: Float[Tensor, "n s_d"], common: Float[Tensor, "k s"]) -> Float[Tensor, "s n d"]:
        """Deviations from the mean that standard normal numbers stand for, before observations of single entries."""
        n, d = self.mean.shape
        along = (self._correlation_root @ correlated).reshape(n, -1, d)
        inner = along.permute(1, 0, 2) + torch.einsum("ndk,ks->snd", self.loadings, common)
        return torch.einsum("nab,snb->sna", self.factor, inner)

    def log_det(self) -> Tensor:
        """Log determinant of the covariance."""
        return self._log_det_inner + 2.0 * torch.linalg.slogdet(self.factor).logabsdet.sum() + self._log_det_explained

    def square(self, x: Float[Tensor, "s n d"]) -> Float[Tensor, " s"]:
        """Squared Mahalanobis distance of movements to the mean."""
        residual = torch.linalg.solve(self.factor, (x - self.mean)[..., None])[..., 0]
        solved = self._solve_inner(residual.permute(1, 2, 0))  # (n, d, s)
        square = (residual.permute(1, 2, 0) * solved).sum((0, 1))
        if self.explained.shape[-1]:
            # Woodbury, for what was taken off.
            cross = torch.einsum("ndp,nds->ps", self._whitened_explained, solved)
            square = square + torch.linalg.solve_triangular(self._explained_root, cross, upper=False).square().sum(0)
        return square

    @cached_property
    def _correlation_root(self) -> Tensor:
        return safe_cholesky(self.correlation, name="the correlation along the movement")

    @cached_property
    def _whitened_loadings(self) -> Float[Tensor, "n d k"]:
        """R^-1 U."""
        n, d, k = self.loadings.shape
        return torch.cholesky_solve(self.loadings.reshape(n, d * k), self._correlation_root).reshape(n, d, k)

    @cached_property
    def _capacitance_root(self) -> Float[Tensor, "k k"]:
        """Factor of I + U' R^-1 U."""
        gram = torch.einsum("ndk,ndl->kl", self.loadings, self._whitened_loadings)
        return torch.linalg.cholesky(symmetrize(gram) + torch.eye(len(gram)).to(gram))

    @cached_property
    def _log_det_inner(self) -> Tensor:
        along = self._correlation_root.diagonal().log().sum() * self.mean.shape[1]
        return 2.0 * (along + self._capacitance_root.diagonal().log().sum())

    def _solve_inner(self, right: Float[Tensor, "n d s"]) -> Float[Tensor, "n d s"]:
        """Solution of ``(R kron I + U U') x = right``."""
        n, d, s = right.shape
        solved = torch.cholesky_solve(right.reshape(n, d * s), self._correlation_root).reshape(n, d, s)
        cross = torch.einsum("ndk,nds->ks", self._whitened_loadings, right)
        return solved - self._whitened_loadings @ torch.cholesky_solve(cross, self._capacitance_root)

    @cached_property
    def _whitened_explained(self) -> Float[Tensor, "n d p"]:
        """A^-1 V."""
        return torch.linalg.solve(self.factor, self.explained)

    @cached_property
    def _explained_root(self) -> Float[Tensor, "p p"]:
        """Factor of I - V' Sigma^-1 V, with Sigma the covariance before anything was taken off."""
        whitened = self._whitened_explained
        gram = torch.einsum("ndp,ndq->pq", whitened, self._solve_inner(whitened))
        return safe_cholesky(
            torch.eye(len(gram)).to(gram) - symmetrize(gram), name="what observations leave open of the movement"
        )

    @cached_property
    def _log_det_explained(self) -> Tensor:
        if not self.explained.shape[-1]:
            return self.mean.new_zeros(())
        return 2.0 * self._explained_root.diagonal().log().sum()
