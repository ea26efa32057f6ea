"""The paper's cost functions over latent values, and their training by L-BFGS."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp import LatentValues
from torch_pbd.linalg import scale_tril_from_root, tril_to_vector
from torch_pbd.models.floor import with_floor
from torch_pbd.optim import FitReport, Progress, minimize


def gaussian_nll(
    root: Float[Tensor, "n d s"], scatter_root: Float[Tensor, "n d r"], counts: Float[Tensor, " n"]
) -> Float[Tensor, ""]:
    """Negative log likelihood of all rows: eq. (11) and (12), from the scatter at each distinct input.

    Parameters
    ----------
    root : Tensor of shape (n, d, s)
        Of the model's covariances; the floor is added here, and keeps the likelihood bounded.
    scatter_root : Tensor of shape (n, d, r)
        Of the sums of ``w w'``, w the residuals from the mean (``TrainingSet.scatter_root``).
    counts : Tensor of shape (n,)
    """
    scale_tril = scale_tril_from_root(with_floor(root))
    whitened = torch.linalg.solve_triangular(scale_tril, scatter_root, upper=False)
    log_det = scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = 0.5 * root.shape[1] * math.log(2 * math.pi) * counts.sum()
    return 0.5 * whitened.square().sum() + (counts * log_det).sum() + constant


def covariance_mse(root: Float[Tensor, "n d s"], empirical_tril: Float[Tensor, "n d d"]) -> Float[Tensor, ""]:
    """Mean squared distance of the vectorized Cholesky factors: J_MSE, eq. (9)."""
    difference = tril_to_vector(scale_tril_from_root(with_floor(root)) - empirical_tril)
    return difference.square().sum(-1).mean()


def train(
    loss: Callable[[Tensor], Tensor],
    latent: LatentValues,
    others: Sequence[Tensor] = (),
    *,
    prior_weight: float,
    max_iter: int,
    tol: float,
    callback: Callable[[Progress], None] | None = None,
) -> FitReport:
    """Minimize ``loss(latent deviations)`` over the latent values and ``others``.

    With a ``prior_weight`` of one the negative log prior density of the latent values is added, which makes
    a likelihood the posterior density and its optimum the MAP; with zero it is the paper's objective.
    """

    def objective() -> Tensor:
        penalty = 0.5 * prior_weight * latent.whitened.square().sum() if prior_weight else 0.0
        return loss(latent()) + penalty

    return minimize(objective, [*latent.trained(), *others], max_iter=max_iter, tol=tol, callback=callback)
