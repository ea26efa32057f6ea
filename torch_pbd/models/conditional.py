"""The fitted model: a normal distribution of y whose mean and covariance depend on x, in the data's units."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp import LatentGP
from torch_pbd.linalg import scale_tril_from_root, symmetrize
from torch_pbd.models.cholesky import CholeskyCovariance
from torch_pbd.models.floor import with_floor
from torch_pbd.models.heteroscedastic import HeteroscedasticModel
from torch_pbd.models.mixture import GaussianMixture
from torch_pbd.models.wishart import WishartCovariance


class MeanAndCovariance(nn.Module):
    """Gaussian processes for the mean beside a model of the covariance's root, in standardized units."""

    def __init__(self, mean: LatentGP, covariance: CholeskyCovariance | WishartCovariance) -> None:
        super().__init__()
        self.mean = mean
        self.covariance = covariance

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]:
        """Mean, and a root of the covariance."""
        return self.mean(x), self.covariance(x, prior_tril)

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out: Type II uncertainty."""
        return self.covariance.variability(x)

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty of the covariance's latent processes."""
        return self.covariance.latent.type1(x)


class ConditionalNormal(nn.Module):
    """Mean and covariance of y given x, in the units of the data; differentiable in x.

    The density is normal, or Student's t with these moments where the core has ``degrees``.

    Parameters
    ----------
    core : MeanAndCovariance, HeteroscedasticModel or GaussianMixture
        Maps standardized inputs (n, e) to a mean (n, d) and a root (n, d, r) of the covariance, and has
        ``type1(x)``.
    x_shift, x_scale : Tensor of shape (e,)
        Standardized inputs are ``(x - x_shift) / x_scale``.
    y_shift, y_scale : Tensor of shape (d,)
        The same for the outputs.
    """

    x_shift: Tensor
    x_scale: Tensor
    y_shift: Tensor
    y_scale: Tensor

    def __init__(
        self,
        core: MeanAndCovariance | HeteroscedasticModel | GaussianMixture,
        x_shift: Float[Tensor, " e"],
        x_scale: Float[Tensor, " e"],
        y_shift: Float[Tensor, " d"],
        y_scale: Float[Tensor, " d"],
    ) -> None:
        super().__init__()
        self.core = core
        self.register_buffer("x_shift", x_shift)
        self.register_buffer("x_scale", x_scale)
        self.register_buffer("y_shift", y_shift)
        self.register_buffer("y_scale", y_scale)

    def forward(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Mean, and lower Cholesky factor of the covariance.

        ``prior_scale_tril`` replaces the prior the model was fitted with, where that depends on x.
        """
        mean, root = self._mean_and_root(x, prior_scale_tril)
        return mean, scale_tril_from_root(root)

    def moments(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Mean, and covariance, symmetric to the last bit."""
        mean, root = self._mean_and_root(x, prior_scale_tril)
        return mean, symmetrize(root @ root.mT)

    def mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, without the work that a covariance takes."""
        core, standardized = self.core, self._standardized(x)
        mean = core(standardized)[0] if isinstance(core, GaussianMixture) else core.mean(standardized)
        return self.y_shift + self.y_scale * mean

    def covariance(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d d"]:
        """Covariance alone, symmetric to the last bit."""
        if not isinstance(self.core, MeanAndCovariance):
            return self.moments(x, prior_scale_tril)[1]
        return self._square(self.core.covariance(*self._arguments(x, prior_scale_tril)))

    def degrees(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"] | None:
        """Degrees of freedom of the predictive Student's t; None where the density is normal everywhere."""
        if not isinstance(self.core, HeteroscedasticModel):
            return None
        return self.core.degrees(self._standardized(x))

    def draw_covariance(
        self,
        x: Float[Tensor, "n e"],
        normal: list[Float[Tensor, "*s _"]],
        prior_scale_tril: Float[Tensor, "n d d"] | None = None,
    ) -> Float[Tensor, "*s n d d"]:
        """Posterior draws of the covariance function at x, each made of standard normal numbers."""
        if not isinstance(self.core, HeteroscedasticModel):
            raise TypeError("only the heteroscedastic model knows the posterior of its covariance")
        prior = None if prior_scale_tril is None else prior_scale_tril / self.y_scale[:, None]
        return self._square(self.core.draw(self._standardized(x), normal, prior))

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty: 0 on data, 1 where only the prior speaks."""
        return self.core.type1(self._standardized(x))

    def type2(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d d"]:
        """Type II uncertainty: the variability of the data, without the prior; squared units of y."""
        standardized = self._standardized(x)
        if isinstance(self.core, GaussianMixture):
            return self._square(self.core(standardized)[1])  # it has no prior
        return self._square(self.core.variability(standardized))

    def _mean_and_root(self, x: Tensor, prior_scale_tril: Tensor | None) -> tuple[Tensor, Tensor]:
        core: Any = self.core
        if torch.compiler.is_compiling() and isinstance(core, HeteroscedasticModel):
            core = torch.compiler.disable(core.forward)  # it looks at numbers on its way, which no graph can hold
        mean, root = core(*self._arguments(x, prior_scale_tril))
        return self.y_shift + self.y_scale * mean, self._in_units(root)

    def _arguments(self, x: Tensor, prior_scale_tril: Tensor | None) -> tuple[Tensor, ...]:
        """What the core takes: standardized inputs, and the prior where it is another than the core's."""
        if prior_scale_tril is None:
            return (self._standardized(x),)
        return self._standardized(x), prior_scale_tril / self.y_scale[:, None]

    def _standardized(self, x: Tensor) -> Tensor:
        return (x - self.x_shift) / self.x_scale

    def _square(self, root: Tensor) -> Tensor:
        """Covariance of a root in standardized units, with the floor, in the units of the data."""
        root = self._in_units(root)
        return symmetrize(root @ root.mT)

    def _in_units(self, root: Tensor) -> Tensor:
        """Root of a covariance, with the floor, in the units of the data."""
        return self.y_scale.unsqueeze(-1) * with_floor(root)
