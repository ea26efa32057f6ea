"""Joint normal law of a whole movement, a correlation along time, times outputs, plus loadings; and conditioned."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize


@dataclass(frozen=True)
class JointNormal:
    """Normal law of n steps of d outputs whose covariance is never formed unless it is asked for.

    A movement is ``x_t = mean_t + A_t (g_t + U_t c)``: g has the correlation R over the steps, independently in each
    output, and c is standard normal. Its covariance is ``A ((R - W W') kron I + U U') A' - V V'``, with A block
    diagonal; W is what observations of whole steps have taken off, V what those of single entries have. Costs grow with
    n^3 + n^2 d + n d (k + p)^2; those of what single steps are, given others, with n alone.
    """

    mean: Float[Tensor, "n d"]
    factor: Float[Tensor, "n d d"]
    """A, one block a step."""
    prior_correlation: Float[Tensor, "n n"]
    """R, positive semidefinite."""
    loadings: Float[Tensor, "n d k"]
    """U."""
    taken: Float[Tensor, "n m"]
    """W."""
    explained: Float[Tensor, "n d p"]
    """V."""

    @classmethod
    def prior(
        cls,
        mean: Float[Tensor, "n d"],
        factor: Float[Tensor, "n d d"],
        correlation: Float[Tensor, "n n"],
        loadings: Float[Tensor, "n d k"],
    ) -> "JointNormal":
        """Law before anything is observed."""
        return cls(mean, factor, correlation, loadings, correlation[:, :0], loadings[:, :, :0])

    @cached_property
    def correlation(self) -> Float[Tensor, "n n"]:
        """R - W W'."""
        return symmetrize(self.prior_correlation - self.taken @ self.taken.mT)

    def at(self, steps: Int[Tensor, " m"]) -> "JointNormal":
        """Law of some of the steps."""
        rows = (part[steps] for part in (self.mean, self.factor, self.prior_correlation[:, steps]))
        return JointNormal(*rows, *(part[steps] for part in (self.loadings, self.taken, self.explained)))

    def joined(self, other: "JointNormal", between: Float[Tensor, "n m"]) -> "JointNormal":
        """Law of the steps of both, of which nothing is observed, and which are correlated between each other."""
        upper = torch.cat([self.prior_correlation, between], dim=1)
        return JointNormal.prior(
            torch.cat([self.mean, other.mean]),
            torch.cat([self.factor, other.factor]),
            torch.cat([upper, torch.cat([between.mT, other.prior_correlation], dim=1)]),
            torch.cat([self.loadings, other.loadings]),
        )

    def covariance(self) -> Float[Tensor, "n d n d"]:
        """Whole covariance: n d squared numbers."""
        # The inner part (R - W W') kron I + U U' first, and then a block of A on either side.
        n, d = self.mean.shape
        inner = torch.einsum("ij,ab->iajb", self.correlation, torch.eye(d).to(self.mean))
        flat = self.loadings.reshape(n * d, -1)
        inner = inner + (flat @ flat.mT).reshape(n, d, n, d)
        explained = self.explained.reshape(n * d, -1)
        whole = torch.einsum("iab,ibjc,jdc->iajd", self.factor, inner, self.factor)
        return symmetrize(whole.reshape(n * d, n * d) - explained @ explained.mT).reshape(n, d, n, d)

    def marginal(self) -> Float[Tensor, "n d d"]:
        """Covariance of the outputs at each step."""
        variance = self.prior_correlation.diagonal() - self.taken.square().sum(1)
        inner = self.loadings @ self.loadings.mT
        inner.diagonal(dim1=1, dim2=2).add_(variance[:, None])
        outer = self.factor @ inner @ self.factor.mT - self.explained @ self.explained.mT
        return symmetrize(outer)

    def columns(self, steps: Int[Tensor, " p"], directions: Float[Tensor, "p d"]) -> Float[Tensor, "n d p"]:
        """Covariance of all steps and outputs with single entries, along directions among the outputs."""
        rows = torch.einsum("pc,pcd->pd", directions, self.factor[steps])
        between = self.prior_correlation[:, steps] - self.taken @ self.taken[steps].mT
        inner = torch.einsum("np,pd->ndp", between, rows)
        inner = inner + self.loadings @ torch.einsum("pd,pdk->kp", rows, self.loadings[steps])
        return self.factor @ inner - self.explained @ torch.einsum("pd,pdq->qp", directions, self.explained[steps])

    def deviations(self, correlated: Float[Tensor, "n s_d"], common: Float[Tensor, "k s"]) -> Float[Tensor, "s n d"]:
        """Deviations from the mean that standard normal numbers stand for, before observations of single entries."""
        n, d = self.mean.shape
        along = (self._correlation_root @ correlated).reshape(n, -1, d)
        inner = along.permute(1, 0, 2) + torch.einsum("ndk,ks->snd", self.loadings, common)
        return torch.einsum("nab,snb->sna", self.factor, inner)

    def log_det(self) -> Tensor:
        """Log determinant of the covariance."""
        # det(R kron I + U U') = det(R)^d det(I + U' inv(R) U), and taking V V' off multiplies the determinant of the
        # whole by det(I - V' inv(Sigma) V).
        along = self._correlation_root.diagonal().log().sum() * self.mean.shape[1]
        log_det = 2.0 * (along + self._capacitance_root.diagonal().log().sum())
        log_det = log_det + 2.0 * torch.linalg.slogdet(self.factor).logabsdet.sum()
        if self.explained.shape[-1]:
            log_det = log_det + 2.0 * self._explained_root.diagonal().log().sum()
        return log_det

    def square(self, x: Float[Tensor, "s n d"]) -> Float[Tensor, " s"]:
        """Squared Mahalanobis distance of movements to the mean."""
        # With S = R kron I + U U' it is r' inv(S) r of r = inv(A) (x - mean).
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

    def _solve_inner(self, right: Float[Tensor, "n d s"]) -> Float[Tensor, "n d s"]:
        """Solution of ``(R kron I + U U') x = right``."""
        # Woodbury: inv(R) - inv(R) U inv(I + U' inv(R) U) U' inv(R), with R for R kron I.
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


class Conditioned:
    """Joint law given what was observed; normal, by the usual formulas.

    Of observations at some of the steps, values (m, d) are NaN where not given, noise (m, d) is the standard deviation
    of their errors, of the outputs x or, with axes, of ``axes x``. Steps known whole and without noise keep the
    structure of the law; all other entries are conditioned on one by one.

    Exact steps E, with ``L L' = R_EE``: of ``r = A_E^-1 (x_E - mean_E)``, G = R_:E R_EE^-1 and the loadings'
    coefficients c, whose posterior has the precision ``P = I + U_E' R_EE^-1 U_E`` and the mean ``P^-1 U_E' R_EE^-1 r``,
    a movement is ``mean + A (G r + (U - G U_E) c + g)``, g of the correlation ``R - W W'`` with ``W = R_:E L'^-1``.
    That is a law of the same form. Single entries then take ``V V'`` off, with V their covariances with all the rest
    over the root of their own.
    """

    def __init__(
        self,
        prior: JointNormal,
        steps: Int[Tensor, " m"],
        values: Float[Tensor, "m d"],
        noise: Float[Tensor, "m d"],
        axes: Float[Tensor, "d d"] | None = None,
    ) -> None:
        given = ~values.isnan()
        exact = (given & (noise == 0.0)).all(1)
        rows, entries = (given & ~exact[:, None]).nonzero().unbind(1)
        self._entry_steps = steps[rows]
        if len(rows):
            self._entry_values, self._entry_noise = values[rows, entries], noise[rows, entries]
            self._directions = (torch.eye(values.shape[1]).to(values) if axes is None else axes)[entries]
        self._prior, self._steps, self._values = prior, steps[exact], values[exact]
        if axes is not None:
            self._values = torch.linalg.solve(axes, self._values.mT).mT
        steps, n_loadings = self._steps, prior.loadings.shape[-1]
        if not len(steps):
            return
        between = prior.prior_correlation[:, steps]
        self._root = safe_cholesky(between[steps], name="the correlation of the steps given")
        self._taken = torch.linalg.solve_triangular(self._root.mT, between, upper=True, left=False)
        self._gain = torch.linalg.solve_triangular(self._root, self._taken, upper=False, left=False)
        loadings = prior.loadings[steps]
        half = torch.linalg.solve_triangular(self._root, loadings.flatten(1), upper=False)
        self._whitened = torch.linalg.solve_triangular(self._root.mT, half, upper=True).reshape(loadings.shape)
        half = half.reshape(-1, n_loadings)
        self._precision_root = torch.linalg.cholesky(half.mT @ half + torch.eye(n_loadings).to(loadings))
        self._open = prior.loadings - (self._gain @ loadings.flatten(1)).reshape(prior.loadings.shape)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Steps, outputs, loadings and single entries."""
        return *self._prior.loadings.shape, len(self._entry_steps)

    @cached_property
    def law(self) -> JointNormal:
        """Law of all steps; those that are known have no variance left."""
        law, steps = self._prior, self._steps
        if len(steps):
            law = replace(
                law,
                mean=law.mean + self._from_steps((self._values - law.mean[steps])[None])[0],
                # What is known has no variance, not even of rounding, which may be below zero.
                factor=law.factor.index_fill(0, steps, 0.0),
                loadings=torch.linalg.solve_triangular(self._precision_root.mT, self._open, upper=True, left=False),
                taken=self._taken,
            )
        if not len(self._entry_steps):
            return law
        columns, root = self._entries(law)
        explained = torch.linalg.solve_triangular(root.mT, columns, upper=True, left=False)
        error = self._entry_values - (self._directions * law.mean[self._entry_steps]).sum(1)
        whitened = torch.linalg.solve_triangular(root, error[:, None], upper=False)[:, 0]
        return replace(law, mean=law.mean + explained @ whitened, explained=explained)

    def deviations(
        self, correlated: Float[Tensor, "n s"], common: Float[Tensor, "k t"], noise: Float[Tensor, "p t"]
    ) -> Float[Tensor, "t n d"]:
        """Draws of the deviation from the mean, from standard normal numbers.

        Draws of the unconditioned law, less what it would have made of their own values at what was observed: no
        root of a singular matrix is needed (Matheron's rule).
        """
        drawn = self._prior.deviations(correlated, common)
        if len(self._steps):
            drawn = drawn - self._from_steps(drawn[:, self._steps])
        if not len(self._entry_steps):
            return drawn
        columns, root = self._entries(self.law)
        errors = (self._directions * drawn[:, self._entry_steps]).sum(-1).mT + self._entry_noise[:, None] * noise
        return drawn - torch.einsum("ndp,ps->snd", columns, torch.cholesky_solve(errors, root))

    def _from_steps(self, residual: Float[Tensor, "s m d"]) -> Float[Tensor, "s n d"]:
        """Change of the mean by what steps that are known whole deviate from it."""
        factor = self._prior.factor
        inner = torch.linalg.solve(factor[self._steps], residual[..., None])[..., 0]
        projected = inner.flatten(1) @ self._whitened.flatten(0, 1)  # (s, k)
        common = torch.cholesky_solve(projected.mT, self._precision_root)
        change = torch.einsum("nm,smd->snd", self._gain, inner) + (self._open @ common).permute(2, 0, 1)
        return torch.einsum("nab,snb->sna", factor, change)

    def _entries(self, law: JointNormal) -> tuple[Float[Tensor, "n d p"], Float[Tensor, "p p"]]:
        """Covariances of everything with the single entries, and the root of their own, noise included."""
        steps, directions = self._entry_steps, self._directions
        columns = replace(law, explained=law.explained[..., :0]).columns(steps, directions)
        own = torch.einsum("pd,pdq->pq", directions, columns[steps]) + torch.diag(self._entry_noise.square())
        return columns, safe_cholesky(symmetrize(own), name="the covariance of the entries given")
