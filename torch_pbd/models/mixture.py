"""Gaussian mixtures over inputs and outputs: regression, expectation maximization, and L-BFGS after it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.linalg import log_det, scale_tril_from_root, triangular_inverse
from torch_pbd.models import Core, MeanAndRoot, PriorTril, Shapes, blank, size_of
from torch_pbd.optim.batch import FitReport, Progress, Status
from torch_pbd.optim.descent import minimize

_BLOCK = 1 << 13  # rows that an E step holds at a time: what it makes of them stays in the cache


@dataclass(frozen=True)
class Components:
    """k weighted Gaussians over p variables."""

    log_weight: Float[Tensor, " k"]
    mean: Float[Tensor, "k p"]
    scale_tril: Float[Tensor, "k p p"]

    def whiten(self, data: Float[Tensor, "n p"]) -> Float[Tensor, "k p n"]:
        """Each row in each component's frame, where that component is N(0, I)."""
        # Entries beyond 2e51 (in float64) are brought back to it: squares of what follows stay finite, no inf - inf.
        limit = torch.finfo(data.dtype).max ** (1 / 6)
        residual = data.clamp(-limit, limit).mT - self.mean.unsqueeze(-1)
        return torch.linalg.solve_triangular(self.scale_tril, residual, upper=False)

    def log_joint(self, whitened: Float[Tensor, "k p n"]) -> Float[Tensor, "k n"]:
        """Log of weight times density, of each component at each row."""
        peak = self.log_weight - log_det(self.scale_tril) - 0.5 * self.mean.shape[-1] * math.log(2 * math.pi)
        return peak.unsqueeze(-1) - 0.5 * whitened.square().sum(1)

    def log_prob(self, data: Float[Tensor, "n p"]) -> Float[Tensor, " n"]:
        """Log density of the mixture."""
        return self.log_joint(self.whiten(data)).logsumexp(0)


class GaussianMixture(Core):
    """Gaussian mixture over the joint vector [x, y] of p = e + d variables; as a core, Gaussian mixture regression.

    Components have weights, of whose logarithms a common constant does not matter, means, and Cholesky factors of
    covariances, by the logarithms of their diagonals and what is below; the ``n_features`` inputs are the leading
    variables.
    """

    kind = "mixture"
    log_density_floor: Tensor

    def __init__(
        self,
        log_weight: Float[Tensor, " k"],
        mean: Float[Tensor, "k p"],
        log_diagonal: Float[Tensor, "k p"],
        strict_lower: Float[Tensor, "k p p"],
        n_features: int,
    ) -> None:
        super().__init__()
        self.n_features = n_features
        self.log_weight, self.mean = nn.Parameter(log_weight), nn.Parameter(mean)
        self.log_diagonal, self.strict_lower = nn.Parameter(log_diagonal), nn.Parameter(strict_lower)
        self.register_buffer("log_density_floor", torch.full_like(mean[:1, 0], -math.inf))

    @property
    def scale_tril(self) -> Float[Tensor, "k p p"]:
        """Lower Cholesky factors of the components' covariances."""
        return self.strict_lower.tril(-1) + torch.diag_embed(self.log_diagonal.exp())

    def log_prob(self, data: Float[Tensor, "n p"]) -> Float[Tensor, " n"]:
        """Log density at each row [x, y], or [x] alone."""
        return self.components(data.shape[1]).log_prob(data)

    def forward(self, x: Float[Tensor, "n e"], prior_tril: PriorTril = None) -> MeanAndRoot:
        """Mean of y given each row of ``x``, and a root of its covariance, r = k (d + 1); there is no prior in it.

        Gaussian mixture regression (Calinon, Intelligent Service Robotics 9, 2016, section 5): with h_k the
        responsibility of component k for x, and mu_k|x and Sigma_k|x the mean and covariance of y in it,

            mean = sum_k h_k mu_k|x,
            root @ root.mT = sum_k h_k (Sigma_k|x + (mu_k|x - mean)(mu_k|x - mean)^T).
        """
        mean, component_mean, log_share = self._means(x)
        root_share = (0.5 * log_share).exp()  # the gradient of sqrt(h) is infinite at h = 0
        between = root_share.unsqueeze(1) * (component_mean - mean.unsqueeze(-1))
        within = torch.einsum("nk,kij->nikj", root_share, self.scale_tril[:, self.n_features :, self.n_features :])
        return mean, torch.cat([within.flatten(2), between], dim=-1)

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, equal to the bit."""
        return self._means(x)[0]

    def _means(self, x: Tensor) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d k"], Float[Tensor, "n k"]]:
        """Means of y given x, of the mixture and of its components, and the logarithms of these' responsibilities."""
        e, inputs = self.n_features, self.components(self.n_features)
        whitened = inputs.whiten(x)
        log_share = inputs.log_joint(whitened).log_softmax(0)
        # Inputs come first, so the joint factor's lower blocks are what a Schur complement would give.
        component_mean = self.mean[:, e:, None] + self.scale_tril[:, e:, :e] @ whitened
        mean = (log_share.exp().unsqueeze(1) * component_mean).sum(0)
        return mean.mT, component_mean.permute(2, 1, 0), log_share.mT

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Distance of each row of ``x`` from data, as 0 on all training inputs to 1 far away.

        It is 1 - min(1, p(x) / p_min), p_min the lowest density of a training input (``log_density_floor``,
        set by the fits). A mixture knows only Type II uncertainty (paper, section IV-C): this measure is
        ours, and the covariance does *not* return to a prior where it is 1.
        """
        return -torch.expm1((self.log_prob(x) - self.log_density_floor).clamp(max=0.0))

    def config(self) -> dict[str, Any]:
        """Number of inputs."""
        return {"covariance": self.kind, "n_features": self.n_features}

    @classmethod
    def skeleton(cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int) -> "GaussianMixture":
        """Mixture without numbers."""
        k, p = size_of(shapes, "log_weight"), n_features + n_outputs
        return cls(blank(k), blank(k, p), blank(k, p), blank(k, p, p), n_features)

    def components(self, size: int | None = None) -> Components:
        """Components over the first ``size`` variables, or over all."""
        log_weight = self.log_weight.log_softmax(0)
        return Components(log_weight, self.mean[:, :size], self.scale_tril[:, :size, :size])


@torch.no_grad()
def expectation_maximization(
    data: Float[Tensor, "n p"],
    responsibilities: Float[Tensor, "n k"],
    *,
    n_features: int,
    reg_covar: float,
    tol: float,
    max_iter: int,
) -> tuple[GaussianMixture, FitReport]:
    """Fit a mixture by expectation maximization, from given responsibilities: the best iterate.

    The updates are those of scikit-learn's ``GaussianMixture(covariance_type="full")``, but carried out in
    each component's present frame: an E step whitens the data and gathers weighted moments, near the identity
    there, and an M step moves the frames. Strongly correlated data keep their digits so.

    The data are inputs and outputs side by side, standardized; responsibilities, the share of each component in each
    row, add up to one, and an M step from them is the first iterate. ``reg_covar`` is added to every variance of every
    component. It ends when the loss, the negative mean log-likelihood in nats per row, changes by less than ``tol``.
    """
    padded = nn.functional.pad(data, (0, 1), value=1.0)  # by ones: moments of order 0 to 2 in one product
    blocks = [block.mT.contiguous() for block in padded.split(_BLOCK)]
    count = responsibilities.sum(0) + 10 * torch.finfo(data.dtype).eps
    mean = responsibilities.mT @ data / count.unsqueeze(-1)
    root = (responsibilities / count).mT.sqrt().unsqueeze(1) * (data.mT - mean.unsqueeze(-1))
    components = best = Components((count / count.sum()).log(), mean, _regular(root, reg_covar))
    loss, moments = _e_step(components, blocks)
    curve, n_iter, converged = [loss], 0, False
    while n_iter < max_iter and not converged:
        n_iter += 1
        components = _m_step(components, moments, reg_covar)
        previous, (loss, moments) = loss, _e_step(components, blocks)
        converged = abs(previous - loss) < tol
        if loss < curve[-1]:
            best, curve = components, [*curve, loss]
    mixture = _with_density_floor(best, data[:, :n_features])
    return mixture, FitReport(curve[-1], tuple(curve), n_iter, Status.CONVERGED if converged else Status.MAX_ITER)


def refine(
    mixture: GaussianMixture,
    data: Float[Tensor, "n p"],
    *,
    reg_covar: float,
    tol: float,
    max_iter: int,
    callback: Callable[[Progress], None] | None = None,
) -> FitReport:
    """Maximize a mixture's likelihood by L-BFGS on all its parameters, in place; never worse than its start.

    The likelihood alone is unbounded: a component may shrink onto a point. So covariances are
    A A^T + reg_covar I with A free: the floor that EM keeps, but maximized with, not added afterwards. Means
    and A are measured in the components' frames at the start, where the problem is nearly isotropic.
    """
    with torch.no_grad():
        start = mixture.components()
        # From C B B' C' = C C' - reg_covar I, which the floor is added to, follows B B' = I - reg_covar C^-1 C^-T.
        inverse = triangular_inverse(start.scale_tril)
        excess, axes = torch.linalg.eigh(torch.eye(data.shape[1]).to(data) - reg_covar * inverse @ inverse.mT)
        spread = (axes * excess.clamp_min(0).sqrt().unsqueeze(-2)).requires_grad_()
        shift = torch.zeros_like(start.mean).requires_grad_()
        log_weight = start.log_weight.clone().requires_grad_()

    def components() -> Components:
        mean = start.mean + (start.scale_tril @ shift.unsqueeze(-1)).squeeze(-1)
        return Components(log_weight.log_softmax(0), mean, _regular(start.scale_tril @ spread, reg_covar))

    def loss() -> Tensor:
        return -components().log_prob(data).mean()

    report = minimize(loss, [log_weight, shift, spread], max_iter=max_iter, tol=tol, callback=callback)
    if len(report.loss_curve) > 1:  # else the start is the best, and stays as it is to the bit
        mixture.load_state_dict(_with_density_floor(components(), data[:, : mixture.n_features]).state_dict())
    return report


@torch.no_grad()
def _with_density_floor(components: Components, inputs: Float[Tensor, "n e"]) -> GaussianMixture:
    """Mixture of these components, which knows the lowest density of the training inputs."""
    log_diagonal = components.scale_tril.diagonal(dim1=-2, dim2=-1).log()
    parts = components.log_weight, components.mean, log_diagonal, components.scale_tril.tril(-1)
    mixture = GaussianMixture(*parts, inputs.shape[1])
    mixture.log_density_floor.fill_(mixture.log_prob(inputs).min())
    return mixture


def _regular(root: Float[Tensor, "k p r"], reg_covar: float) -> Float[Tensor, "k p p"]:
    """Lower Cholesky factors of ``root @ root.mT + reg_covar * I``."""
    scale_tril = scale_tril_from_root(root, math.sqrt(reg_covar))
    rounding = root.shape[-2] * torch.finfo(root.dtype).eps * scale_tril.detach().norm(dim=-1)
    if (scale_tril.diagonal(dim1=-2, dim2=-1) <= rounding).any():
        raise NotPositiveDefiniteError("A component has collapsed: raise reg_covar, or take fewer.")
    return scale_tril


def _e_step(components: Components, blocks: list[Tensor]) -> tuple[float, Float[Tensor, "k q q"]]:
    """Negative mean log-likelihood, and each component's weighted moments in its own frame, q = p + 1."""
    k, p = components.mean.shape
    # Maps of [x, 1] to [C^-1 (x - mean), 1], so that one product whitens a block for all components.
    affine = torch.eye(p + 1).to(components.mean).repeat(k, 1, 1)
    affine[:, :p, p:] = -components.mean.unsqueeze(-1)
    affine[:, :p] = torch.linalg.solve_triangular(components.scale_tril, affine[:, :p], upper=False)
    loss, moments = affine.new_zeros(()), torch.zeros_like(affine)
    for block in blocks:
        whitened = affine @ block
        log_joint = components.log_joint(whitened[:, :p])
        largest = log_joint.amax(0)
        share = (log_joint - largest).exp()
        total = share.sum(0)
        loss -= (largest + total.log()).sum()
        moments += ((share / total).unsqueeze(1) * whitened) @ whitened.mT
    return float(loss) / sum(block.shape[1] for block in blocks), moments


def _m_step(components: Components, moments: Float[Tensor, "k q q"], reg_covar: float) -> Components:
    """Most likely components, given moments in the frames of the present ones."""
    frame, p = components.scale_tril, components.mean.shape[-1]
    eps = torch.finfo(moments.dtype).eps
    count = moments[:, p, p] + 10 * eps  # a component that has lost all its data stays where it is
    # With mean s and second moment M in a frame C, mean and covariance are C s more, and C (M - s s') C'.
    shift = moments[:, :p, p:] / count[:, None, None]
    second = moments[:, :p, :p] / count[:, None, None]
    variance, axes = torch.linalg.eigh(second - shift @ shift.mT)
    rounding = p * eps * second.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    scale = torch.where(variance > rounding, variance, 0.0).sqrt()
    mean = components.mean + (frame @ shift).squeeze(-1)
    root = frame @ (axes * scale.unsqueeze(-2))
    return Components((count / count.sum()).log(), mean, _regular(root, reg_covar))
