"""Joint normal law of a whole movement, a correlation along time per output plus loadings, and its conditioning."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.linalg import log_density_at, log_det, safe_cholesky, spectral_map, symmetrize

Along = Callable[[Tensor, Tensor], Tensor]
"""Correlation R between times (n,) and others (m,): (c, n, m)."""


@dataclass(frozen=True)
class JointNormal:
    """Normal law of n steps of d outputs whose covariance is formed only by :meth:`covariance`.

    A movement is ``x_t = mean_t + A_t (g_t + U_t c)``: entry j of g has the correlation R_j over the steps and is
    independent of the others, and c is standard normal. The covariance is ``A (R - W W' + U U') A' - V V'``, with A
    block diagonal in the steps, and R, positive semidefinite, and W in the outputs, of which one may stand for all; W
    is the reduction by observations of whole steps, V that by single entries. Costs grow with d n^3 + n d (k + p)^2;
    the marginals of single steps, given others, cost n alone: of R they need the columns of what is given.
    """

    mean: Float[Tensor, "n d"]
    factor: Float[Tensor, "n d d"]  # A
    time: Float[Tensor, " n"]
    along: Along
    variance: Float[Tensor, ""]  # R's diagonal
    loadings: Float[Tensor, "n d k"]  # U
    taken: Float[Tensor, "c n m"]  # W
    explained: Float[Tensor, "n d p"]  # V

    @classmethod
    def prior(
        cls, mean: Tensor, factor: Tensor, time: Tensor, along: Along, variance: Tensor, loadings: Tensor
    ) -> "JointNormal":
        """Law before anything is observed."""
        return cls(mean, factor, time, along, variance, loadings, mean.new_zeros(1, len(mean), 0), loadings[..., :0])

    @classmethod
    def with_noise(
        cls,
        time: Float[Tensor, " n"],
        mean: Float[Tensor, "n d"],
        loadings: Float[Tensor, "n d k"],
        scale: Float[Tensor, " d"],
    ) -> "JointNormal":
        """Law of ``mean_t + loadings_t c`` plus noise of this scale, independent in all steps and outputs."""
        factor = scale.diag().expand(*mean.shape, len(scale))
        return cls.prior(mean, factor, time, _independent, mean.new_ones(()), loadings / scale[:, None])

    @cached_property
    def _correlation(self) -> Float[Tensor, "c n n"]:
        """Correlation R - W W' given the observations of whole steps."""
        return symmetrize(self.along(self.time, self.time) - self.taken @ self.taken.mT)

    @cached_property
    def correlation_root(self) -> Float[Tensor, "c n n"]:
        """Lower Cholesky factor of R - W W'."""
        return safe_cholesky(self._correlation, name="the correlation along the movement")

    def at(self, steps: Int[Tensor, " m"]) -> "JointNormal":
        """Law of the selected steps."""
        rows = {name: getattr(self, name)[steps] for name in ("mean", "factor", "time", "loadings", "explained")}
        return replace(self, taken=self.taken[:, steps], **rows)

    def covariance(self) -> Float[Tensor, "n d n d"]:
        """Covariance of all outputs at all steps."""
        # The inner part R - W W' + U U' first, and then a block of A on either side.
        n, d = self.mean.shape
        inner = torch.diag_embed(self._correlation.expand(d, n, n).permute(1, 2, 0)).transpose(1, 2)
        flat = self.loadings.flatten(0, 1)
        inner = inner + (flat @ flat.mT).reshape(n, d, n, d)
        explained = self.explained.flatten(0, 1)
        whole = torch.einsum("iab,ibjc,jdc->iajd", self.factor, inner, self.factor)
        return symmetrize(whole.reshape(n * d, n * d) - explained @ explained.mT).reshape(n, d, n, d)

    def marginal(self) -> Float[Tensor, "n d d"]:
        """Covariance of the outputs at each step."""
        variance = self.variance - self.taken.square().sum(2)
        inner = self.loadings @ self.loadings.mT
        inner.diagonal(dim1=1, dim2=2).add_(variance.mT)
        whole = symmetrize(self.factor @ inner @ self.factor.mT - self.explained @ self.explained.mT)
        # Rounding may leave less than nothing of the variance of what was observed exactly, but for whole steps.
        singular = (torch.linalg.cholesky_ex(whole).info > 0) & whole.flatten(1).any(1)
        if bool(singular.any()):
            whole[singular] = spectral_map(whole[singular], lambda variance: variance.clamp_min(0.0))
        return whole

    def log_density(self, x: Float[Tensor, "n d"], df: float) -> float:
        """Log density of a movement under Student's t of this covariance, or the normal law for infinite ``df``."""
        # The residual and V, before A, and U, all whitened by R - W W'.
        inner = torch.linalg.solve(self.factor, torch.cat([(x - self.mean)[..., None], self.explained], dim=2))
        columns = torch.cat([self.loadings, inner], dim=2).transpose(0, 1)
        root = self.correlation_root
        whitened = torch.linalg.solve_triangular(root, columns, upper=False).flatten(0, 1)
        loadings, rows = whitened.tensor_split([self.loadings.shape[2]], dim=1)
        # Woodbury: with the capacitance C = I + U' U, the determinant of S = I + U U' is that of C, and the squares
        # under inv(S) are those of what is left of a regression on U, (I - U inv(C) U') z, and of its coefficients.
        capacitance = loadings.mT @ loadings
        capacitance_root = torch.linalg.cholesky(capacitance + torch.eye(len(capacitance)).to(root))
        weights = torch.cholesky_solve(loadings.mT @ rows, capacitance_root)
        left = rows - loadings @ weights
        gram = left.mT @ left + weights.mT @ weights
        # Woodbury once more, for V V' that was taken off: its capacitance is I - V' inv(Sigma) V.
        rest = torch.eye(len(gram) - 1).to(gram) - gram[1:, 1:]
        rest_root = safe_cholesky(rest, name="what observations leave open of the movement")
        cross = torch.linalg.solve_triangular(rest_root, gram[1:, :1], upper=False)
        log_dets = torch.linalg.slogdet(self.factor).logabsdet.sum() + log_det(root).sum() * (x.shape[1] // len(root))
        log_dets = log_dets + log_det(capacitance_root) + log_det(rest_root)
        square = gram[0, 0] + cross.square().sum()
        degrees = square.new_tensor(df) if math.isfinite(df) else None
        return float(log_density_at(square, x.numel(), degrees) - log_dets)


class Conditioned:
    """Joint normal law given observations, ``law``.

    The observations at some of the steps have values (m, d), NaN where not given, and noise (m, d), the standard
    deviation of their errors; they are of ``axes x``. Steps known whole and without noise keep the structure of the
    law; all other entries are conditioned on one by one.

    For exact steps E with ``L L' = R_EE``, let ``r = A_E^-1 (x_E - mean_E)`` and G = R_:E R_EE^-1. The loadings'
    coefficients c have the posterior precision ``P = I + U_E' R_EE^-1 U_E`` and mean ``P^-1 U_E' R_EE^-1 r``, and a
    movement is ``mean + A (G r + (U - G U_E) c + g)``, with g of the correlation ``R - W W'``, ``W = R_:E L'^-1``: a
    law of the same form. Single entries then subtract ``V V'``, V being their covariances with all steps times the
    inverse root of their own.
    """

    def __init__(
        self, prior: JointNormal, steps: Int[Tensor, " m"], values: Tensor, noise: Tensor, axes: Float[Tensor, "d d"]
    ) -> None:
        given = ~values.isnan()
        exact = (given & (noise == 0.0)).all(1)
        rows, entries = (given & ~exact[:, None]).nonzero().unbind(1)
        self._prior, self._steps, self._entry_steps = prior, steps[exact], steps[rows]
        self._directions, self._entry_noise = axes[entries], noise[rows, entries]
        law = self._given_steps(prior) if len(self._steps) else prior
        law = self._given_entries(law) if len(rows) else law
        known = torch.linalg.solve(axes, values[exact].mT).mT
        self.law = replace(law, mean=self._passing(prior.mean[None], known, values[rows, entries])[0])

    def _given_steps(self, law: JointNormal) -> JointNormal:
        """Law, but for its mean, given steps known whole."""
        between = law.along(law.time, law.time[self._steps])  # of all steps, and those given
        root = safe_cholesky(between[:, self._steps], name="the correlation of the steps given")
        taken = torch.linalg.solve_triangular(root.mT, between, upper=True, left=False)
        self._gain = torch.linalg.solve_triangular(root, taken, upper=False, left=False)
        loadings = law.loadings[self._steps].transpose(0, 1)  # (d, m, k)
        half = torch.linalg.solve_triangular(root, loadings, upper=False)
        self._whitened = torch.linalg.solve_triangular(root.mT, half, upper=True)
        half = half.flatten(0, 1)
        self._precision_root = torch.linalg.cholesky(half.mT @ half + torch.eye(half.shape[1]).to(half))
        self._open = law.loadings - (self._gain @ loadings).transpose(0, 1)
        left = _over_root(self._open, self._precision_root)
        # What is known has no variance, not even of rounding, which may be below zero.
        return replace(law, factor=law.factor.index_fill(0, self._steps, 0.0), loadings=left, taken=taken)

    def _given_entries(self, law: JointNormal) -> JointNormal:
        """Law, but for its mean, given single entries too."""
        steps, directions = self._entry_steps, self._directions
        rows = torch.einsum("pc,pcd->pd", directions, law.factor[steps])
        between = law.along(law.time, law.time[steps]) - law.taken @ law.taken[:, steps].mT
        inner = between.transpose(0, 1) * rows.mT
        inner = inner + law.loadings @ torch.einsum("pd,pdk->kp", rows, law.loadings[steps])
        # Covariances of all steps with the entries, and the root of the entries' own.
        self._columns = law.factor @ inner
        own = torch.einsum("pd,pdq->pq", directions, self._columns[steps]) + self._entry_noise.square().diag()
        self._entry_root = safe_cholesky(symmetrize(own), name="the covariance of the entries given")
        return replace(law, explained=_over_root(self._columns, self._entry_root))

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
        noise = self._entry_noise[:, None] * normal((len(self._entry_noise), n_draws))
        return self._passing(drawn, torch.zeros_like(prior.mean[self._steps]), -noise.mT)

    def _passing(
        self, x: Float[Tensor, "s n d"], values: Float[Tensor, "m d"], entries: Float[Tensor, "*s p"]
    ) -> Float[Tensor, "s n d"]:
        """Movements moved, as the unconditioned law has them vary together, to these values of what was observed."""
        if len(self._steps):
            factor, residual = self._prior.factor, values - x[:, self._steps]
            inner = torch.linalg.solve(factor[self._steps], residual[..., None])[..., 0]
            projected = torch.einsum("smd,dmk->sk", inner, self._whitened)
            common = torch.cholesky_solve(projected.mT, self._precision_root)
            change = (self._gain @ inner.permute(2, 1, 0)).permute(2, 1, 0) + (self._open @ common).permute(2, 0, 1)
            x = x + torch.einsum("nab,snb->sna", factor, change)
        if not len(self._entry_steps):
            return x
        errors = entries - (self._directions * x[:, self._entry_steps]).sum(-1)
        return x + torch.einsum("ndp,ps->snd", self._columns, torch.cholesky_solve(errors.mT, self._entry_root))


def _independent(time: Float[Tensor, " n"], other: Float[Tensor, " m"]) -> Float[Tensor, "1 n m"]:
    return (time[:, None] == other).to(time)[None]


def _over_root(rows: Float[Tensor, "n d p"], root: Float[Tensor, "p p"]) -> Float[Tensor, "n d p"]:
    """Rows times the inverse transpose of a lower factor, of all steps at once: batches would repeat it for each."""
    return torch.linalg.solve_triangular(root.mT, rows.flatten(0, 1), upper=True, left=False).reshape(rows.shape)
