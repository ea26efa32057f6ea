"""Joint normal law of a whole movement, a correlation along time per output plus loadings, and its conditioning."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize


@dataclass(frozen=True)
class JointNormal:
    """Normal law of n steps of d outputs whose covariance is formed only by :meth:`covariance`.

    A movement is ``x_t = mean_t + A_t (g_t + U_t c)``: entry j of g has the correlation R_j over the steps and is
    independent of the others, and c is standard normal. The covariance is ``A (R - W W' + U U') A' - V V'``, with A
    block diagonal in the steps, and R and W in the outputs, of which one may stand for all; W is the reduction by
    observations of whole steps, V that by single entries. Costs grow with d n^3 + n d (k + p)^2; the marginals of
    single steps, given others, cost n alone.
    """

    mean: Float[Tensor, "n d"]
    factor: Float[Tensor, "n d d"]
    """A, one block a step."""
    prior_correlation: Float[Tensor, "c n n"]
    """R, positive semidefinite."""
    loadings: Float[Tensor, "n d k"]
    """U."""
    taken: Float[Tensor, "c n m"]
    """W."""
    explained: Float[Tensor, "n d p"]
    """V."""

    @classmethod
    def prior(
        cls,
        mean: Float[Tensor, "n d"],
        factor: Float[Tensor, "n d d"],
        correlation: Float[Tensor, "c n n"],
        loadings: Float[Tensor, "n d k"],
    ) -> "JointNormal":
        """Law before anything is observed."""
        return cls(mean, factor, correlation, loadings, correlation[..., :0], loadings[..., :0])

    @classmethod
    def with_noise(
        cls, mean: Float[Tensor, "n d"], loadings: Float[Tensor, "n d k"], scale: Float[Tensor, " d"]
    ) -> "JointNormal":
        """Law of ``mean_t + loadings_t c`` plus noise of this scale, independent in all steps and outputs."""
        n, d = mean.shape
        return cls.prior(mean, scale.diag().expand(n, d, d), torch.eye(n).to(mean)[None], loadings / scale[:, None])

    @cached_property
    def _correlation(self) -> Float[Tensor, "c n n"]:
        """Correlation R - W W' given the observations of whole steps."""
        return symmetrize(self.prior_correlation - self.taken @ self.taken.mT)

    @cached_property
    def correlation_root(self) -> Float[Tensor, "c n n"]:
        """Lower Cholesky factor of R - W W'."""
        return safe_cholesky(self._correlation, name="the correlation along the movement")

    def at(self, steps: Int[Tensor, " m"]) -> "JointNormal":
        """Law of the selected steps."""
        mean, factor, loadings, explained = (
            part[steps] for part in (self.mean, self.factor, self.loadings, self.explained)
        )
        between = self.prior_correlation[:, steps][:, :, steps]
        return JointNormal(mean, factor, between, loadings, self.taken[:, steps], explained)

    def joined(self, other: "JointNormal", between: Float[Tensor, "c n m"]) -> "JointNormal":
        """Law of the steps of two unobserved laws with the correlation ``between`` them."""
        upper = torch.cat([self.prior_correlation, between], dim=2)
        return JointNormal.prior(
            torch.cat([self.mean, other.mean]),
            torch.cat([self.factor, other.factor]),
            torch.cat([upper, torch.cat([between.mT, other.prior_correlation], dim=2)], dim=1),
            torch.cat([self.loadings, other.loadings]),
        )

    def covariance(self) -> Float[Tensor, "n d n d"]:
        """Covariance of all outputs at all steps."""
        # The inner part R - W W' + U U' first, and then a block of A on either side.
        n, d = self.mean.shape
        inner = torch.diag_embed(self._correlation.expand(d, n, n).permute(1, 2, 0)).transpose(1, 2)
        flat = self.loadings.reshape(n * d, -1)
        inner = inner + (flat @ flat.mT).reshape(n, d, n, d)
        explained = self.explained.reshape(n * d, -1)
        whole = torch.einsum("iab,ibjc,jdc->iajd", self.factor, inner, self.factor)
        return symmetrize(whole.reshape(n * d, n * d) - explained @ explained.mT).reshape(n, d, n, d)

    def marginal(self) -> Float[Tensor, "n d d"]:
        """Covariance of the outputs at each step."""
        variance = self.prior_correlation.diagonal(dim1=1, dim2=2) - self.taken.square().sum(2)
        inner = self.loadings @ self.loadings.mT
        inner.diagonal(dim1=1, dim2=2).add_(variance.mT)
        return symmetrize(self.factor @ inner @ self.factor.mT - self.explained @ self.explained.mT)

    def log_density(self, x: Float[Tensor, "n d"], df: float) -> float:
        """Log density of a movement under Student's t of this covariance, or the normal law for infinite ``df``."""
        root, loadings = self.correlation_root, self.loadings

        def solve_correlation(right: Float[Tensor, "n d s"]) -> Float[Tensor, "n d s"]:
            return torch.cholesky_solve(right.transpose(0, 1), root).transpose(0, 1)

        # The inner matrix S = R + U U' by Woodbury: inv(R) - inv(R) U inv(C) U' inv(R) of the capacitance
        # C = I + U' inv(R) U; its determinant is det(R) det(C).
        whitened = solve_correlation(loadings)
        gram = torch.einsum("ndk,ndl->kl", loadings, whitened)
        capacitance_root = torch.linalg.cholesky(symmetrize(gram) + torch.eye(len(gram)).to(gram))
        n_alike = x.shape[1] // len(root)
        along = n_alike * root.diagonal(dim1=1, dim2=2).log().sum()
        log_det = 2.0 * (along + capacitance_root.diagonal().log().sum())
        log_det = log_det + 2.0 * torch.linalg.slogdet(self.factor).logabsdet.sum()

        def solve_inner(right: Float[Tensor, "n d s"]) -> Float[Tensor, "n d s"]:
            cross = torch.einsum("ndk,nds->ks", whitened, right)
            return solve_correlation(right) - whitened @ torch.cholesky_solve(cross, capacitance_root)

        residual = torch.linalg.solve(self.factor, (x - self.mean)[..., None])
        solved = solve_inner(residual)
        square = (residual * solved).sum()
        if self.explained.shape[-1]:
            # Woodbury once more, for V V' that was taken off: it multiplies the determinant by that of
            # I - V' inv(Sigma) V.
            inner = torch.linalg.solve(self.factor, self.explained)
            gram = torch.einsum("ndp,ndq->pq", inner, solve_inner(inner))
            rest = torch.eye(len(gram)).to(gram) - symmetrize(gram)
            rest_root = safe_cholesky(rest, name="what observations leave open of the movement")
            cross = torch.einsum("ndp,nds->ps", inner, solved)
            square = square + torch.linalg.solve_triangular(rest_root, cross, upper=False).square().sum()
            log_det = log_det + 2.0 * rest_root.diagonal().log().sum()
        half, size = 0.5 * float(log_det), x.numel()
        if not math.isfinite(df):
            return -0.5 * (float(square) + size * math.log(2.0 * math.pi)) - half
        # linalg.student_log_density is the same but takes a factor of the covariance, which is never formed here.
        constant = math.lgamma(0.5 * (df + size)) - math.lgamma(0.5 * df) - 0.5 * size * math.log((df - 2.0) * math.pi)
        return constant - half - 0.5 * (df + size) * math.log1p(float(square) / (df - 2.0))


class Conditioned:
    """Joint normal law given observations.

    The observations at some of the steps have values (m, d), NaN where not given, and noise (m, d), the standard
    deviation of their errors; they are of the outputs x or, with axes, of ``axes x``. Steps known whole and without
    noise keep the structure of the law; all other entries are conditioned on one by one.

    For exact steps E with ``L L' = R_EE``, let ``r = A_E^-1 (x_E - mean_E)`` and G = R_:E R_EE^-1. The loadings'
    coefficients c have the posterior precision ``P = I + U_E' R_EE^-1 U_E`` and mean ``P^-1 U_E' R_EE^-1 r``, and a
    movement is ``mean + A (G r + (U - G U_E) c + g)``, with g of the correlation ``R - W W'``, ``W = R_:E L'^-1``: a
    law of the same form. Single entries then subtract ``V V'``, V being their covariances with all steps times the
    inverse root of their own.
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
        between = prior.prior_correlation[:, :, steps]
        root = safe_cholesky(between[:, steps], name="the correlation of the steps given")
        self._taken = torch.linalg.solve_triangular(root.mT, between, upper=True, left=False)
        self._gain = torch.linalg.solve_triangular(root, self._taken, upper=False, left=False)
        loadings = prior.loadings[steps].transpose(0, 1)  # (d, m, k)
        half = torch.linalg.solve_triangular(root, loadings, upper=False)
        self._whitened = torch.linalg.solve_triangular(root.mT, half, upper=True)
        half = half.reshape(-1, n_loadings)
        self._precision_root = torch.linalg.cholesky(half.mT @ half + torch.eye(n_loadings).to(loadings))
        self._open = prior.loadings - (self._gain @ loadings).transpose(0, 1)

    @cached_property
    def law(self) -> JointNormal:
        """Law of all steps; known ones have no variance left."""
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

    def deviations(self, n_draws: int, normal: Callable[[tuple[int, int]], Tensor]) -> Float[Tensor, "s n d"]:
        """Draws of the deviation from the mean; ``normal`` gives standard normal numbers of a requested shape.

        Each is a draw of the unconditioned law minus its conditional mean given its own values at the observed
        entries (Matheron's rule), so that no root of a singular matrix is needed.
        """
        prior = self._prior
        n, d, n_loadings = prior.loadings.shape
        along = prior.correlation_root @ normal((d * n, n_draws)).reshape(d, n, n_draws)
        inner = along.permute(2, 1, 0) + torch.einsum("ndk,ks->snd", prior.loadings, normal((n_loadings, n_draws)))
        drawn = torch.einsum("nab,snb->sna", prior.factor, inner)
        if len(self._steps):
            drawn = drawn - self._from_steps(drawn[:, self._steps])
        if not len(self._entry_steps):
            return drawn
        columns, root = self._entries(self.law)
        noise = self._entry_noise[:, None] * normal((len(self._entry_steps), n_draws))
        errors = (self._directions * drawn[:, self._entry_steps]).sum(-1).mT + noise
        return drawn - torch.einsum("ndp,ps->snd", columns, torch.cholesky_solve(errors, root))

    def _from_steps(self, residual: Float[Tensor, "s m d"]) -> Float[Tensor, "s n d"]:
        """Change of the mean by the residuals of steps that are known whole."""
        factor = self._prior.factor
        inner = torch.linalg.solve(factor[self._steps], residual[..., None])[..., 0]
        projected = torch.einsum("smd,dmk->sk", inner, self._whitened)
        common = torch.cholesky_solve(projected.mT, self._precision_root)
        change = (self._gain @ inner.permute(2, 1, 0)).permute(2, 1, 0) + (self._open @ common).permute(2, 0, 1)
        return torch.einsum("nab,snb->sna", factor, change)

    def _entries(self, law: JointNormal) -> tuple[Float[Tensor, "n d p"], Float[Tensor, "p p"]]:
        """Covariances of all steps with the single entries, given the exact steps, and the root of the entries' own."""
        steps, directions = self._entry_steps, self._directions
        rows = torch.einsum("pc,pcd->pd", directions, law.factor[steps])
        between = law.prior_correlation[:, :, steps] - law.taken @ law.taken[:, steps].mT
        inner = between.transpose(0, 1) * rows.mT
        inner = inner + law.loadings @ torch.einsum("pd,pdk->kp", rows, law.loadings[steps])
        columns = law.factor @ inner
        own = torch.einsum("pd,pdq->pq", directions, columns[steps]) + torch.diag(self._entry_noise.square())
        return columns, safe_cholesky(symmetrize(own), name="the covariance of the entries given")
