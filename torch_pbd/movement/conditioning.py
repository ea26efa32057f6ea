"""Conditioning of a movement on what is known of it: whole steps, single outputs, with noise or without."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.movement.joint import JointNormal


@dataclass(frozen=True)
class Observed:
    """What is known of a movement, at steps of a joint law.

    Steps known whole and without noise keep the structure of the law; other entries are conditioned on one by one.
    """

    steps: Int[Tensor, " m"]
    """Steps that are known whole."""
    values: Float[Tensor, "m d"]
    entry_steps: Int[Tensor, " p"]
    entry_outputs: Int[Tensor, " p"]
    entry_values: Float[Tensor, " p"]
    entry_variances: Float[Tensor, " p"]
    """Variance of the error of each single entry."""


class Conditioned:
    """Joint law given what was observed; normal, by the usual formulas.

    Exact steps E: with ``r = A_E^-1 (x_E - mean_E)``, G = R_:E R_EE^-1 and the loadings' coefficients c, whose
    posterior has the precision ``P = I + U_E' R_EE^-1 U_E`` and the mean ``P^-1 U_E' R_EE^-1 r``, a movement is
    ``mean + A (G r + (U - G U_E) c + g)``, g of the correlation ``R - G R_E:``. That is a law of the same form.
    Single entries then take ``V V'`` off, with V their covariances with all the rest over the root of their own.
    """

    def __init__(self, prior: JointNormal, observed: Observed) -> None:
        self._prior, self._observed = prior, observed
        steps, n_loadings = observed.steps, prior.loadings.shape[-1]
        if not len(steps):
            return
        self._root = safe_cholesky(prior.correlation[steps][:, steps], name="the correlation of the steps given")
        self._gain = torch.cholesky_solve(prior.correlation[steps], self._root).mT
        loadings = prior.loadings[steps]
        self._whitened = torch.cholesky_solve(loadings.flatten(1), self._root).reshape(loadings.shape)
        precision = torch.einsum("mdk,mdl->kl", loadings, self._whitened) + torch.eye(n_loadings).to(loadings)
        self._precision_root = torch.linalg.cholesky(symmetrize(precision))
        self._open = prior.loadings - torch.einsum("nm,mdk->ndk", self._gain, loadings)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Steps, outputs, loadings and single entries."""
        return *self._prior.loadings.shape, len(self._observed.entry_values)

    @cached_property
    def law(self) -> JointNormal:
        """Law of all steps; those that are known have no variance left."""
        law, observed = self._from_whole_steps(), self._observed
        if not len(observed.entry_steps):
            return law
        columns, root = self._entries(law)
        explained = torch.linalg.solve_triangular(root.mT, columns, upper=True, left=False)
        error = observed.entry_values - law.mean[observed.entry_steps, observed.entry_outputs]
        whitened = torch.linalg.solve_triangular(root, error[:, None], upper=False)[:, 0]
        return replace(law, mean=law.mean + explained @ whitened, explained=explained)

    def _from_whole_steps(self) -> JointNormal:
        prior, observed = self._prior, self._observed
        if not len(observed.steps):
            return prior
        correlation = symmetrize(prior.correlation - self._gain @ prior.correlation[observed.steps])
        loadings = torch.linalg.solve_triangular(self._precision_root.mT, self._open, upper=True, left=False)
        # What is known has no variance, not even of rounding, which may be below zero.
        correlation = correlation.index_fill(0, observed.steps, 0.0).index_fill(1, observed.steps, 0.0)
        return replace(
            prior,
            mean=prior.mean + self._from_steps((observed.values - prior.mean[observed.steps])[None])[0],
            correlation=correlation,
            loadings=loadings.index_fill(0, observed.steps, 0.0),
        )

    def deviations(
        self, correlated: Float[Tensor, "n s"], common: Float[Tensor, "k t"], noise: Float[Tensor, "p t"]
    ) -> Float[Tensor, "t n d"]:
        """Draws of the deviation from the mean, from standard normal numbers.

        Draws of the unconditioned law, less what it would have made of their own values at what was observed: no
        root of a singular matrix is needed (Matheron's rule).
        """
        observed = self._observed
        drawn = self._prior.deviations(correlated, common)
        if len(observed.steps):
            drawn = drawn - self._from_steps(drawn[:, observed.steps])
        if not len(observed.entry_steps):
            return drawn
        columns, root = self._entries(self.law)
        errors = drawn[:, observed.entry_steps, observed.entry_outputs].mT
        errors = errors + observed.entry_variances.sqrt()[:, None] * noise
        return drawn - torch.einsum("ndp,ps->snd", columns, torch.cholesky_solve(errors, root))

    def _from_steps(self, residual: Float[Tensor, "s m d"]) -> Float[Tensor, "s n d"]:
        """Change of the mean by what steps that are known whole deviate from it."""
        factor = self._prior.factor
        inner = torch.linalg.solve(factor[self._observed.steps], residual[..., None])[..., 0]
        projected = torch.einsum("mdk,smd->ks", self._whitened, inner)
        common = torch.cholesky_solve(projected, self._precision_root)
        change = torch.einsum("nm,smd->snd", self._gain, inner) + torch.einsum("ndk,ks->snd", self._open, common)
        return torch.einsum("nab,snb->sna", factor, change)

    def _entries(self, law: JointNormal) -> tuple[Float[Tensor, "n d p"], Float[Tensor, "p p"]]:
        """Covariances of everything with the single entries, and the root of their own, noise included."""
        steps, outputs = self._observed.entry_steps, self._observed.entry_outputs
        columns = replace(law, explained=law.explained[..., :0]).columns(steps, outputs)
        own = columns[steps, outputs] + torch.diag(self._observed.entry_variances)
        return columns, safe_cholesky(symmetrize(own), name="the covariance of the entries given")
