"""Parts of the fitted model that are computed once for all its predictions."""

import operator
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.inducing import Features
from torch_pbd.gp.observations import spacing
from torch_pbd.models.heteroscedastic.covariance import LatentCovariance
from torch_pbd.models.heteroscedastic.mean import LatentMean

# Longest length scale by which distance from the data is judged, in ranges of the input times the number of inputs;
# but two spacings of the inducing inputs at least.
_REACH = 0.1


@dataclass(frozen=True)
class Prepared:
    """Processes of a module's buffers, with what does not depend on the inputs computed."""

    buffers: tuple[Tensor | None, ...]
    versions: tuple[int, ...]
    mean: LatentMean
    covariance: LatentCovariance
    nearness: Features
    """Features of the process that tells how far data are."""
    together: list[tuple[list[int], list[int], Features]]
    """Groups of mean (0), log variances (1), coefficients (2) and nearness (3) on the same inducing inputs: which they
    are, how many processes each has, and their features.
    """

    @classmethod
    def of(cls, buffers: tuple[Tensor | None, ...], mean: LatentMean, covariance: LatentCovariance) -> "Prepared":
        """Parts of these processes that do not depend on the inputs.

        What is missing is told by one with the length scale of the log variances (their mean, weighted by squared
        amplitudes), as far as that does not reach too far: a smooth process without noise claims to know what is
        two of its length scales away, in gaps and beyond the data.
        """
        family, theta = covariance.log_variance_family, covariance.log_variance_theta
        inducing = family.features.inducing
        weight = family.amplitude_of(theta).square()
        scale = ((weight / weight.sum()) @ family.length_scale_of(theta).log()).exp()
        scale = scale.clamp_max(_REACH * inducing.shape[1]).clamp_min(2.0 * spacing(inducing))
        nearness = replace(family.features, kernel="squared_exponential", stretch=None)(scale[None])
        rows = covariance.rows.features if covariance.coefficients else None
        parts = [mean.processes.features, covariance.log_variances.features, rows, nearness]
        return cls(buffers, cls._versions(buffers), mean, covariance, nearness, _together(parts))

    def features(self, x: Float[Tensor, "n e"]) -> list[Any]:
        """Features at x of mean, log variances, coefficients (None for one output) and nearness, of unit variance."""
        result: list[Tensor | None] = [None] * 4
        for numbers, sizes, prepared in self.together:
            for number, values in zip(numbers, prepared(x).split(sizes), strict=True):
                result[number] = values
        return result

    def is_of(self, buffers: tuple[Tensor | None, ...]) -> bool:
        """Whether these are the buffers, and as they were."""
        same = len(buffers) == len(self.buffers) and all(map(operator.is_, buffers, self.buffers))
        return same and self.versions == self._versions(buffers)

    @staticmethod
    def _versions(buffers: tuple[Tensor | None, ...]) -> tuple[int, ...]:
        return tuple(-1 if buffer is None or buffer.is_inference() else buffer._version for buffer in buffers)


def _together(parts: list[Features | None]) -> list[tuple[list[int], list[int], Features]]:
    groups: list[tuple[list[int], list[Features]]] = []
    for number, part in enumerate(parts):
        if part is None:
            continue
        for numbers, others in groups:
            if _same_inputs(part, others[0]):
                numbers.append(number)
                others.append(part)
                break
        else:
            groups.append(([number], [part]))
    return [(numbers, [len(part.factor) for part in own], _stacked(own)) for numbers, own in groups]


def _same_inputs(part: Features, other: Features) -> bool:
    mine, its = part.features, other.features
    return mine.kernel == its.kernel and mine.stretch is its.stretch and torch.equal(mine.inducing, its.inducing)


def _stacked(parts: list[Features]) -> Features:
    length_scale = torch.cat([part.length_scale for part in parts])
    return Features(parts[0].features, length_scale, torch.cat([part.factor for part in parts]))
