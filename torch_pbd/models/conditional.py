"""Fitted models: the cores of CD and WP, and any core's normal distribution of y given x in the data's units."""

import json
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd import checks
from torch_pbd.files.memory import require_memory
from torch_pbd.gp.observations import Hyperparameters, LatentGP
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import scale_tril_from_root, symmetrize
from torch_pbd.models import Core, MeanAndRoot, PriorTril, Shapes, blank, floor_of, size_of, with_floor
from torch_pbd.models.links import CholeskyLink, Link, WishartLink, padded


class MeanAndCovariance(Core):
    """Gaussian processes for the mean beside the latent processes of a covariance's root (CD and WP).

    ``bounded`` is whether the part of the prior in the root is kept between nothing and the prior.
    """

    covariance: Any
    """Module of the latent processes and the prior, whose name is in files."""
    _prior: ClassVar[str]
    """Name of the prior there."""
    _link: ClassVar[type[Link]]

    def __init__(self, mean: LatentGP, latent: LatentGP, link: Link, *, bounded: bool = False) -> None:
        super().__init__()
        self.mean, self.covariance, self.bounded = mean, nn.Module(), bounded
        self.covariance.latent, self.log_diagonal = latent, link.log_diagonal
        self.covariance.register_buffer(self._prior, link.prior)

    def link(self, prior_tril: Float[Tensor, "*n d d"] | None = None) -> Link:
        """From the processes to the root, with the prior of the fit or another."""
        prior = getattr(self.covariance, self._prior)
        prior = prior if prior_tril is None else padded(prior_tril, prior.shape[1])
        return self._link(prior, self.log_diagonal, getattr(self.covariance, "scale_matrix_tril", None))

    def forward(self, x: Float[Tensor, "n e"], prior_tril: PriorTril = None) -> MeanAndRoot:
        """Mean, and a root of the covariance."""
        return self.mean(x), self.predict_root(x, prior_tril)

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone."""
        return self.mean(x)

    def predict_root(self, x: Float[Tensor, "n e"], prior_tril: PriorTril = None) -> Float[Tensor, "n d r"]:
        """Root of the covariance alone."""
        link, latent = self.link(prior_tril), self.covariance.latent
        return link.bounded(latent.both(x)) if self.bounded else link.root(latent(x))

    def variability(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d r"]:
        """Root of the covariance with the prior taken out: zero far from data."""
        return self.link().unflatten(self.covariance.latent.values(x))

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Type I uncertainty of the covariance's latent processes."""
        return self.covariance.latent.type1(x)

    def config(self) -> dict[str, Any]:
        """Kernels, and whether the part of the prior is bounded."""
        kernels = {"mean_kernel": self.mean.kernel, "kernel": self.covariance.latent.kernel}
        return {"covariance": self.kind, **kernels, "bounded": self.bounded}

    @classmethod
    def skeleton(
        cls, config: Mapping[str, Any], shapes: Shapes, n_features: int, n_outputs: int
    ) -> "MeanAndCovariance":
        """Core without numbers."""
        link, n_processes = cls._blank_link(config, shapes, n_outputs)
        mean = _blank_processes(shapes, "mean", n_outputs, n_features, config["mean_kernel"])
        latent = _blank_processes(shapes, "covariance.latent", n_processes, n_features, config["kernel"])
        return cls(mean, latent, link, bounded=bool(config.get("bounded", False)))

    @classmethod
    @abstractmethod
    def _blank_link(cls, config: Mapping[str, Any], shapes: Shapes, n_outputs: int) -> tuple[Link, int]:
        """Link without numbers, and its number of processes."""


class MeanAndCholesky(MeanAndCovariance):
    """Core of the Cholesky decomposition approach."""

    kind, _prior, _link = "cholesky", "prior_tril", CholeskyLink

    def config(self) -> dict[str, Any]:
        """Kernels, and on what the processes act."""
        return {**super().config(), "log_diagonal": self.log_diagonal}

    @classmethod
    def _blank_link(cls, config: Mapping[str, Any], shapes: Shapes, n_outputs: int) -> tuple[CholeskyLink, int]:
        link = CholeskyLink(blank(n_outputs, n_outputs), bool(config["log_diagonal"]))
        return link, n_outputs * (n_outputs + 1) // 2


class MeanAndWishart(MeanAndCovariance):
    """Core of the Wishart process approach, at the mean of its latent processes.

    The prior is L, the lower factor of the scale matrix, times the means of the vectors: its square is the covariance
    far from data, and stays so while L is trained.
    """

    kind, _prior, _link = "wishart", "prior_root", WishartLink

    def __init__(self, mean: LatentGP, latent: LatentGP, link: Link, *, bounded: bool = False) -> None:
        super().__init__(mean, latent, link, bounded=bounded)
        matrix = torch.eye(len(link.prior)).to(link.prior) if link.scale_matrix_tril is None else link.scale_matrix_tril
        self.covariance.scale_matrix_tril = nn.Parameter(matrix.detach())

    @classmethod
    def _blank_link(cls, config: Mapping[str, Any], shapes: Shapes, n_outputs: int) -> tuple[WishartLink, int]:
        df = size_of(shapes, "covariance.prior_root", 1)
        link = WishartLink(blank(n_outputs, df), scale_matrix_tril=blank(n_outputs, n_outputs))
        return link, n_outputs * df


def _blank_processes(shapes: Shapes, prefix: str, n_processes: int, n_features: int, kernel: Any) -> LatentGP:
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
    return LatentGP(blank(n_inputs, n_features), *weights, Hyperparameters(*scales), blank(n_inputs), kernel, root)


class ConditionalNormal(nn.Module):
    """Mean and covariance of y given x, in the units of the data; differentiable in x.

    The density is normal, or Student's t with these moments where the core has ``degrees``. The core works on
    ``(x - x_shift) / x_scale`` and ``(y - y_shift) / y_scale``.
    """

    x_shift: Float[Tensor, " e"]
    x_scale: Float[Tensor, " e"]
    y_shift: Float[Tensor, " d"]
    y_scale: Float[Tensor, " d"]

    def __init__(self, core: Core, x_shift: Tensor, x_scale: Tensor, y_shift: Tensor, y_scale: Tensor) -> None:
        super().__init__()
        self.core = core
        units = {"x_shift": x_shift, "x_scale": x_scale, "y_shift": y_shift, "y_scale": y_scale}
        for name, unit in units.items():
            self.register_buffer(name, unit)

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

    def forward(self, x: Float[Tensor, "n e"], prior_scale_tril: PriorTril = None) -> MeanAndRoot:
        """Mean, and lower Cholesky factor of the covariance.

        ``prior_scale_tril`` replaces the prior the model was fitted with, where that depends on x.
        """
        # By a QR decomposition of the root, whose square is not formed: correlations near one keep their digits.
        mean, root = self.core(self._standardized(x), self._standardized_prior(prior_scale_tril))
        # The floor comes before the units: relative to all outputs, it would drown one that has a large unit.
        return self.y_shift + self.y_scale * mean, scale_tril_from_root(self.y_scale[:, None] * with_floor(root))

    def moments(self, x: Float[Tensor, "n e"], prior_scale_tril: PriorTril = None) -> tuple[Tensor, Tensor]:
        """Mean (n, d), and covariance (n, d, d), symmetric to the last bit."""
        mean, root = self.core(self._standardized(x), self._standardized_prior(prior_scale_tril))
        return self.y_shift + self.y_scale * mean, self._square(root)

    def mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, without the work that a covariance takes."""
        return self.y_shift + self.y_scale * self.core.predict_mean(self._standardized(x))

    def covariance(self, x: Float[Tensor, "n e"], prior_scale_tril: PriorTril = None) -> Float[Tensor, "n d d"]:
        """Covariance alone, symmetric to the last bit."""
        prior = self._standardized_prior(prior_scale_tril)
        return self._square(self.core.predict_root(self._standardized(x), prior))

    def degrees(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"] | None:
        """Degrees of freedom of the predictive Student's t; None where the density is normal everywhere."""
        return self.core.degrees(self._standardized(x))

    def draw_covariance(
        self, x: Float[Tensor, "n e"], normal: list[Float[Tensor, "*s _"]], prior_scale_tril: PriorTril = None
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
        covariance = symmetrize(root @ root.mT)
        covariance.diagonal(dim1=-2, dim2=-1).add_(floor_of(root).squeeze(-1))
        return self.y_scale[:, None] * self.y_scale * covariance
