"""Fitting of Gaussian mixtures: expectation maximization, and L-BFGS after it."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.exceptions import NotPositiveDefiniteError
from torch_pbd.linalg import scale_tril_from_root
from torch_pbd.models.mixture import Components, GaussianMixture
from torch_pbd.optim import FitReport, Progress, Status, minimize

_BLOCK = 1 << 13  # rows that an E step holds at a time: what it makes of them stays in the cache


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
    """Fit a mixture by expectation maximization, from given responsibilities.

    The updates are those of scikit-learn's ``GaussianMixture(covariance_type="full")``, but carried out in
    each component's present frame: an E step whitens the data and gathers weighted moments, near the identity
    there, and an M step moves the frames. Strongly correlated data keep their digits this way.

    Parameters
    ----------
    data : Tensor of shape (n, e + d)
        Inputs and outputs side by side, standardized.
    responsibilities : Tensor of shape (n, k)
        Share of each component in each row; rows add up to one. An M step from them is the first iterate.
    n_features : int
        Number of inputs e.
    reg_covar : float
        Added to every variance of every component. The data being standardized, it is a share of theirs.
    tol, max_iter : float, int
        Stop when the mean log-likelihood, in nats per row, changes by less than ``tol``.

    Returns
    -------
    mixture, report : GaussianMixture, FitReport
        The best iterate, and its loss: the negative mean log-likelihood, in nats per row.

    Raises
    ------
    NotPositiveDefiniteError
        If a component collapses and ``reg_covar`` is zero.
    """
    padded = nn.functional.pad(data, (0, 1), value=1.0)  # by ones: moments of order 0 to 2 in one product
    blocks = [block.mT.contiguous() for block in padded.split(_BLOCK)]
    components = best = _first_m_step(data, responsibilities, reg_covar)
    loss, moments = _e_step(components, blocks)
    curve, n_iter, converged = [loss], 0, False
    while n_iter < max_iter and not converged:
        n_iter += 1
        components = _m_step(components, moments, reg_covar)
        previous, (loss, moments) = loss, _e_step(components, blocks)
        converged = abs(previous - loss) < tol
        if loss < curve[-1]:
            best, curve = components, [*curve, loss]
    mixture = GaussianMixture(best.log_weight, best.mean, best.scale_tril, n_features)
    mixture.log_density_floor.copy_(mixture.log_prob_input(data[:, :n_features]).min())
    status = Status.CONVERGED if converged else Status.MAX_ITER
    return mixture, FitReport(curve[-1], tuple(curve), n_iter, status)


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

    Parameters
    ----------
    mixture, data, reg_covar
        As :func:`expectation_maximization` takes and leaves them; its report's loss is reported too.
    tol, max_iter, callback
        As in :func:`~torch_pbd.optim.minimize`.

    Raises
    ------
    ValueError
        If ``reg_covar`` is not above zero, or the mixture has a variance below it.
    """
    with torch.no_grad():
        start = mixture.components()
        spread = _spread_above(start.scale_tril, reg_covar).requires_grad_()
        shift = torch.zeros_like(start.mean).requires_grad_()
        log_weight = start.log_weight.clone().requires_grad_()

    def components() -> Components:
        mean = start.mean + (start.scale_tril @ shift.unsqueeze(-1)).squeeze(-1)
        return Components(log_weight.log_softmax(0), mean, _regular(start.scale_tril @ spread, reg_covar))

    def loss() -> Tensor:
        return -components().log_prob(data).mean()

    report = minimize(loss, [log_weight, shift, spread], max_iter=max_iter, tol=tol, callback=callback)
    if len(report.loss_curve) > 1:  # else the start is the best, and stays as it is to the bit
        best = components()
        refined = GaussianMixture(best.log_weight, best.mean, best.scale_tril, mixture.n_features)
        refined.log_density_floor = refined.log_prob_input(data[:, : mixture.n_features]).detach().min()
        mixture.load_state_dict(refined.state_dict())
    return report


def _spread_above(scale_tril: Float[Tensor, "k p p"], reg_covar: float) -> Float[Tensor, "k p p"]:
    """The B for which scale_tril B B^T scale_tril^T + reg_covar I are the covariances."""
    identity = torch.eye(scale_tril.shape[-1]).to(scale_tril).expand_as(scale_tril)
    inverse = torch.linalg.solve_triangular(scale_tril, identity, upper=False)
    excess, axes = torch.linalg.eigh(identity - reg_covar * inverse @ inverse.mT)
    if not reg_covar > 0 or (excess < -(torch.finfo(excess.dtype).eps ** 0.5)).any():
        raise ValueError(f"reg_covar is {reg_covar:g}: it must be above 0, and at most what the mixture has.")
    return axes * excess.clamp_min(0).sqrt().unsqueeze(-2)


def _regular(root: Float[Tensor, "k p r"], reg_covar: float) -> Float[Tensor, "k p p"]:
    """Lower Cholesky factors of ``root @ root.mT + reg_covar * I``."""
    floor = (math.sqrt(reg_covar) * torch.eye(root.shape[-2]).to(root)).expand(len(root), -1, -1)
    scale_tril = scale_tril_from_root(torch.cat([root, floor], dim=-1))
    rounding = root.shape[-2] * torch.finfo(root.dtype).eps * scale_tril.detach().norm(dim=-1)
    if (scale_tril.diagonal(dim1=-2, dim2=-1) <= rounding).any():
        raise NotPositiveDefiniteError("A component has collapsed: raise reg_covar, or take fewer.")
    return scale_tril


def _first_m_step(data: Float[Tensor, "n p"], share: Float[Tensor, "n k"], reg_covar: float) -> Components:
    count = share.sum(0) + 10 * torch.finfo(data.dtype).eps
    mean = share.mT @ data / count.unsqueeze(-1)
    root = (share / count).mT.sqrt().unsqueeze(1) * (data.mT - mean.unsqueeze(-1))
    return Components((count / count.sum()).log(), mean, _regular(root, reg_covar))


def _e_step(components: Components, blocks: list[Tensor]) -> tuple[float, Float[Tensor, "k q q"]]:
    """Negative mean log-likelihood, and each component's weighted moments in its own frame, q = p + 1."""
    k, p = components.mean.shape
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
    """The most likely components, given moments in the present ones' frames."""
    frame, p = components.scale_tril, components.mean.shape[-1]
    eps = torch.finfo(moments.dtype).eps
    count = moments[:, p, p] + 10 * eps  # a component that has lost all its data stays where it is
    shift = moments[:, :p, p:] / count[:, None, None]
    second = moments[:, :p, :p] / count[:, None, None]
    variance, axes = torch.linalg.eigh(second - shift @ shift.mT)
    rounding = p * eps * second.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    scale = torch.where(variance > rounding, variance, 0.0).sqrt()
    mean = components.mean + (frame @ shift).squeeze(-1)
    root = frame @ (axes * scale.unsqueeze(-2))
    return Components((count / count.sum()).log(), mean, _regular(root, reg_covar))
