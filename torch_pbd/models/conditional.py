"""Fitted models: a normal distribution of y given x in the data's units, and the protocol of the cores inside."""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd import checks
from torch_pbd.files.memory import require_memory
from torch_pbd.gp import Hyperparameters, LatentGP
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import scale_tril_from_root, symmetrize

VARIANCE_FLOOR = 1e-12
"""Added to every variance, relative to one plus the sum of the variances; outputs have unit variance."""

Shapes = Mapping[str, torch.Size]


def with_floor(root: Float[Tensor, "*b d r"]) -> Float[Tensor, "*b d s"]:
    """Root of a covariance with the floor added: positive definite, whatever ``root`` is.

    It is in the losses as well as in predictions: a likelihood is then bounded, and the fit knows what is predicted.
    """
    floor = (VARIANCE_FLOOR * (1.0 + root.square().sum((-2, -1), keepdim=True))).sqrt()
    return torch.cat([root, floor * torch.eye(root.shape[-2], dtype=root.dtype, device=root.device)], dim=-1)


class Core(nn.Module, ABC):
    """Mean and covariance of standardized outputs, given standardized inputs: all that a model has learned.

    It is in ``config()`` and in the ``state_dict``, which files and pickles hold; the ``skeleton`` of the one takes up
    the other.
    """

    kind: ClassVar[str]
    """Name of the class in files."""

    @abstractmethod
    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]:
        """Mean, and a root of the covariance; ``prior_tril`` replaces the prior of the fit, if there is one."""

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, equal to the bit."""
        return self(x)[0]

    def predict_root(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d r"]:
        """Root of the covariance alone, equal to the bit."""
        return self(x, prior_tril)[1]

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out, if there is one: Type II uncertainty."""
        return self.predict_root(x)

    @abstractmethod
    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty: 0 on data, 1 where only the prior speaks."""

    def degrees(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"] | None:
        """Degrees of freedom of the predictive Student's t; None where the density is normal everywhere."""
        return None

    @abstractmethod
    def config(self) -> dict[str, Any]:
        """All that is not in the ``state_dict``, as JSON can hold it; ``kind`` under "covariance"."""

    @classmethod
    @abstractmethod
    def skeleton(cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int) -> "Core":
        """Core of a ``config()`` without numbers, as large as the arrays of these names and shapes say."""


def beside_prior(
    root: Float[Tensor, "*n d r"], values: Float[Tensor, "*n d r"], prior: Float[Tensor, "*m d r"]
) -> Float[Tensor, "*n d r"]:
    """Root of a covariance whose part beside ``values``, those without prior, is kept between nothing and the prior.

    It is the prior times one less an interpolation of ones, which swings to 1.14 between two inputs: of a prior far
    above the values, as of a movement of many standard deviations, it would take more away than there is.
    """
    return values + (root - values).clamp(prior.clamp_max(0.0), prior.clamp_min(0.0))


class MeanAndCovariance(Core):
    """Gaussian processes for the mean beside a covariance of latent processes, by its root (CD and WP).

    ``covariance`` maps inputs, and another prior, to roots; it has ``latent``, ``bounded`` and ``variability``.
    """

    def __init__(self, mean: LatentGP, covariance: Any) -> None:
        super().__init__()
        self.mean, self.covariance = mean, covariance

    def forward(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]:
        """Mean, and a root of the covariance."""
        return self.mean(x), self.covariance(x, prior_tril)

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone."""
        return self.mean(x)

    def predict_root(
        self, x: Float[Tensor, "n e"], prior_tril: Float[Tensor, "n d d"] | None = None
    ) -> Float[Tensor, "n d r"]:
        """Root of the covariance alone."""
        return self.covariance(x, prior_tril)

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out: zero far from data."""
        return self.covariance.variability(x)

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty of the covariance's latent processes."""
        return self.covariance.latent.type1(x)

    def config(self) -> dict[str, Any]:
        """Kernels, and whether the part of the prior is bounded."""
        latent, bounded = self.covariance.latent, self.covariance.bounded
        return {"covariance": self.kind, "mean_kernel": self.mean.kernel, "kernel": latent.kernel, "bounded": bounded}


def blank(*shape: int) -> Tensor:
    """Tensor of a skeleton: a shape that takes no memory."""
    return torch.empty(shape, dtype=torch.float64, device="meta")


def size_of(shapes: Shapes, name: str, dimension: int = 0) -> int:
    """Size of an array, one or more."""
    shape = shapes.get(name, ())
    if len(shape) <= dimension or not shape[dimension]:
        raise ValueError(f"array {name!r} is missing or empty, or has too few dimensions")
    return shape[dimension]


def latent_skeleton(shapes: Shapes, prefix: str, n_processes: int, n_features: int, kernel: Any) -> LatentGP:
    """Latent processes without numbers, for the arrays whose names start with ``prefix``."""
    n_inputs, n_scales = size_of(shapes, f"{prefix}.inputs"), size_of(shapes, f"{prefix}.length_scale")
    n_scales = min(n_scales, n_processes)  # all share one, or each has its own
    # The matrices of eq. (6) are made anew from the inputs.
    what = f"a model of {n_inputs} inputs"
    require_memory(2 * 8 * n_scales * n_inputs**2, what=what, remedy="Take one with fewer.")
    scales = blank(1 if n_scales == 1 else n_processes, n_features), blank(n_processes), blank(n_processes)
    weights = blank(n_processes, n_inputs), blank(n_processes, n_inputs)
    root = blank(size_of(shapes, f"{prefix}.root"), n_inputs) if f"{prefix}.root" in shapes else None
    checks.choice(kernel, "kernel", KERNELS)
    return LatentGP(
        blank(n_inputs, n_features), *weights, Hyperparameters(*scales), blank(n_inputs), kernel=kernel, root=root
    )


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

        Errors (of value, type, look-up or run time) say that a value or a tensor is missing, unknown, or of another
        type or shape, or that the model would not fit in memory. Nothing is allocated before.
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
        # By a QR decomposition of the root, whose square is not formed: correlations near one keep their digits.
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
        # The floor comes before the units: relative to all outputs, it would drown one that has a large unit.
        return self.y_scale.unsqueeze(-1) * with_floor(root)
