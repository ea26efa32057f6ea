"""The fitted model: a normal distribution of y whose mean and covariance depend on x, in the data's units."""

import json
from collections.abc import Mapping
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.linalg import scale_tril_from_root, symmetrize
from torch_pbd.models.core import Core, blank, size_of, with_floor


class ConditionalNormal(nn.Module):
    """Mean and covariance of y given x, in the units of the data; differentiable in x.

    The density is normal, or Student's t with these moments where the core has ``degrees``.

    Parameters
    ----------
    core : Core
    x_shift, x_scale : Tensor of shape (e,)
        Standardized inputs are ``(x - x_shift) / x_scale``.
    y_shift, y_scale : Tensor of shape (d,)
        Standardized outputs are ``(y - y_shift) / y_scale``.
    """

    x_shift: Tensor
    x_scale: Tensor
    y_shift: Tensor
    y_scale: Tensor

    def __init__(
        self,
        core: Core,
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

    @classmethod
    def restored(cls, core_class: type[Core], config: Any, state: Mapping[str, Tensor]) -> "ConditionalNormal":
        """Model of its core's ``config()`` and of its ``state_dict()``, whose tensors it takes over.

        Raises
        ------
        ValueError, TypeError, LookupError, RuntimeError
            If a value or a tensor is missing, unknown, or of another type or shape; or if the model would not fit in
            memory. Nothing is allocated before.
        """
        if not isinstance(config, Mapping) or config.get("covariance") != core_class.kind:
            raise ValueError("its model is of another class")
        shapes = {name.removeprefix("core."): tensor.shape for name, tensor in state.items()}
        n_features, n_outputs = size_of(shapes, "x_shift"), size_of(shapes, "y_shift")
        core = core_class.skeleton(config, shapes, n_features, n_outputs)
        # Spelled out, since 0 equals False; what the first files do not say is as the class has it.
        given, own = (json.dumps({**core.config(), **more}, sort_keys=True) for more in (config, {}))
        if given != own:
            raise ValueError(f"its model is described by {given:.300}, must be by {own:.300}")
        module = cls(core, blank(n_features), blank(n_features), blank(n_outputs), blank(n_outputs))
        module.load_state_dict(state, strict=True, assign=True)
        return module

    def forward(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Mean, and lower Cholesky factor of the covariance.

        ``prior_scale_tril`` replaces the prior the model was fitted with, where that depends on x.
        """
        mean, root = self.core(self._standardized(x), self._standardized_prior(prior_scale_tril))
        return self.y_shift + self.y_scale * mean, scale_tril_from_root(self._in_units(root))

    def moments(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Mean, and covariance, symmetric to the last bit."""
        mean, root = self.core(self._standardized(x), self._standardized_prior(prior_scale_tril))
        return self.y_shift + self.y_scale * mean, self._square(root)

    def mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, without the work that a covariance takes."""
        return self.y_shift + self.y_scale * self.core.predict_mean(self._standardized(x))

    def covariance(
        self, x: Float[Tensor, "n e"], prior_scale_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d d"]:
        """Covariance alone, symmetric to the last bit."""
        prior = self._standardized_prior(prior_scale_tril)
        return self._square(self.core.predict_root(self._standardized(x), prior))

    def degrees(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"] | None:
        """Degrees of freedom of the predictive Student's t; None where the density is normal everywhere."""
        return self.core.degrees(self._standardized(x))

    def draw_covariance(
        self,
        x: Float[Tensor, "n e"],
        normal: list[Float[Tensor, "*s _"]],
        prior_scale_tril: Float[Tensor, "n d d"] | None = None,
    ) -> Float[Tensor, "*s n d d"]:
        """Posterior draws of the covariance function at x, each made of standard normal numbers.

        Only the heteroscedastic core knows the posterior of its covariance.
        """
        core: Any = self.core
        return self._square(core.draw(self._standardized(x), normal, self._standardized_prior(prior_scale_tril)))

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty: 0 on data, 1 where only the prior speaks."""
        return self.core.type1(self._standardized(x))

    def type2(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d d"]:
        """Type II uncertainty: the variability of the data, without the prior; squared units of y."""
        return self._square(self.core.variability(self._standardized(x)))

    def _standardized(self, x: Tensor) -> Tensor:
        return (x - self.x_shift) / self.x_scale

    def _standardized_prior(self, prior_scale_tril: Tensor | None) -> Tensor | None:
        return None if prior_scale_tril is None else prior_scale_tril / self.y_scale[:, None]

    def _square(self, root: Tensor) -> Tensor:
        """Covariance of a root in standardized units, with the floor, in the units of the data."""
        root = self._in_units(root)
        return symmetrize(root @ root.mT)

    def _in_units(self, root: Tensor) -> Tensor:
        """Root of a covariance, with the floor, in the units of the data."""
        return self.y_scale.unsqueeze(-1) * with_floor(root)
