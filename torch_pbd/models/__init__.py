"""Learned covariances as torch modules, whose cores work on standardized data."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

VARIANCE_FLOOR = 1e-12
"""Added to every variance, relative to one plus the sum of the variances; outputs have unit variance."""

Shapes = Mapping[str, torch.Size]
PriorTril = Float[Tensor, "n d d"] | None
"""Factor of a prior at each query, which replaces that of the fit, if there is one."""
MeanAndRoot = tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]


def with_floor(root: Float[Tensor, "*b d r"]) -> Float[Tensor, "*b d s"]:
    """Root of a covariance with the floor added: positive definite, whatever ``root`` is.

    It is in the losses as well as in predictions: a likelihood is then bounded, and the fit knows what is predicted.
    """
    return torch.cat([root, floor_of(root).sqrt() * torch.eye(root.shape[-2]).to(root)], dim=-1)


def floor_of(root: Float[Tensor, "*b d r"]) -> Float[Tensor, "*b 1 1"]:
    """Floor under the variances of a root's covariance."""
    return VARIANCE_FLOOR * (1.0 + root.square().sum((-2, -1), keepdim=True))


class Core(nn.Module, ABC):
    """Mean and covariance of standardized outputs, given standardized inputs: all that a model has learned.

    It is in ``config()`` and in the ``state_dict``, which files and pickles hold; the ``skeleton`` of the one takes up
    the other.
    """

    kind: ClassVar[str]
    """Name of the class in files."""

    @abstractmethod
    def forward(self, x: Float[Tensor, "n e"], prior_tril: PriorTril = None) -> MeanAndRoot:
        """Mean, and a root of the covariance."""

    def predict_mean(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Mean alone, equal to the bit."""
        return self(x)[0]

    def predict_root(self, x: Float[Tensor, "n e"], prior_tril: PriorTril = None) -> Float[Tensor, "n d r"]:
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


def blank(*shape: int) -> Tensor:
    """Tensor of a skeleton: a shape that takes no memory."""
    return torch.empty(shape, dtype=torch.float64, device="meta")


def size_of(shapes: Shapes, name: str, dimension: int = 0) -> int:
    """Size of an array, one or more."""
    shape = shapes.get(name, ())
    if len(shape) <= dimension or not shape[dimension]:
        raise ValueError(f"array {name!r} is missing or empty, or has too few dimensions")
    return shape[dimension]
