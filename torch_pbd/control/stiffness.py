"""Stiffness from covariance: eq. (19) and (20)."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_semidefinite
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import spectral_map

Bounds = Literal["quantile", "sigma", "variance"]
# On the tunnel task these spread K_xx over 50 to 1000 N/m, and it rises at 214 N/m/s: at 1155 with the paper's bounds.
_QUANTILES = (0.1, 0.9)
# Smallest deviation that counts: squares of smaller ones are no numbers.
_SMALLEST = 1e-150


@final
@dataclass(frozen=True)
class StiffnessLaw:
    """Stiff where the standard deviation is small, compliant where it is large: eq. (19) and (20).

    Each principal axis of a covariance gets ``stiffness_max`` up to a standard deviation of ``sigma_low``,
    ``stiffness_min`` from ``sigma_high``, and a straight line between them. As a function of the covariance
    the result is continuous, through crossings of eigenvalues too, where its principal axes are not; its
    gradient is finite there.

    Parameters
    ----------
    stiffness_min, stiffness_max : float, default=50.0, 1000.0
        In N/m, 0 < stiffness_min <= stiffness_max. The paper's, Table II.
    sigma_low, sigma_high : float, default=None
        Bounds of the standard deviation in its units, 0 <= sigma_low < sigma_high. With bounds="quantile" they are
        taken from the covariances of each call, or once for all by :meth:`fitted`.
    bounds : {"quantile", "sigma", "variance"}, default="quantile"
        What the two bounds are. "sigma": standard deviations, eq. (20) as printed. "variance": variances, whose
        roots are taken; the paper's 3.5e-4 and 1.2e-3 give its Figure 8 only so. "quantile": the 10 % and 90 %
        quantiles of the standard deviations along all axes of all covariances given; leave the two None.
    smooth : bool, default=False
        Replace the straight line by ``3 u^2 - 2 u^3``: the stiffness then has a continuous derivative.

    Examples
    --------
    >>> import torch
    >>> law = StiffnessLaw(sigma_low=0.01, sigma_high=0.03, bounds="sigma")
    >>> law(torch.diag(torch.tensor([0.001, 0.02]).double() ** 2)).diagonal().round(decimals=3).tolist()
    [1000.0, 525.0]
    """

    stiffness_min: float = 50.0
    stiffness_max: float = 1000.0
    sigma_low: float | None = None
    sigma_high: float | None = None
    bounds: Bounds = "quantile"
    smooth: bool = False

    def __post_init__(self) -> None:
        checks.flag(self.smooth, "smooth")
        checks.choice(self.bounds, "bounds", Bounds)
        checks.number(self.stiffness_min, "stiffness_min", above=0.0, unit="N/m")
        checks.number(self.stiffness_max, "stiffness_max", least=self.stiffness_min, unit="N/m")
        if self.bounds == "quantile":
            if (self.sigma_low, self.sigma_high) != (None, None):
                raise InvalidParameterError(
                    f"sigma_low={self.sigma_low} and sigma_high={self.sigma_high} are standard deviations: give "
                    "bounds='sigma' with them (or 'variance'). bounds='quantile' takes its own from the covariances."
                )
            return
        remedy = "or let bounds='quantile' take both from the covariances"
        low = checks.number(self.sigma_low, "sigma_low", least=0.0, remedy=remedy)
        checks.number(self.sigma_high, "sigma_high", above=low, remedy=remedy)

    def __call__(self, covariance: Float[Tensor, "*b d d"] | Any) -> Float[Tensor, "*b d d"]:
        """Stiffness in N/m of covariances (..., d, d), positive semidefinite; symmetric to the last bit."""
        matrix, spectrum = as_semidefinite(covariance, "covariance")
        low, high = self._quantiles(spectrum[0]) if self.bounds == "quantile" else self._scales()
        return spectral_map(matrix, lambda variance: self._stiffness(variance, low, high), spectrum)

    def fitted(self, covariance: Float[Tensor, "*b d d"] | Any, *, resolution: float = 0.0) -> "StiffnessLaw":
        """Law with its bounds fixed, as standard deviations, to those of ``covariance`` (..., d, d).

        For quantiles, smaller standard deviations count as ``resolution``. If the covariances do not vary at all, every
        axis counts as precise, with a warning.
        """
        checks.number(resolution, "resolution", least=0.0)
        matrix, _ = as_semidefinite(covariance, "covariance")
        quantile = self.bounds == "quantile"
        low, high = self._quantiles(torch.linalg.eigvalsh(matrix.detach()), resolution) if quantile else self._scales()
        return replace(self, sigma_low=low, sigma_high=high, bounds="sigma")

    def _stiffness(self, variance: Tensor, low: float, high: float) -> Tensor:
        """Stiffness (..., d) along axes of these variances: eq. (20)."""
        # The root is taken of what is above the lower bound, so its gradient at zero is never asked for.
        scale = variance.clamp_min(max(low**2, torch.finfo(variance.dtype).tiny)).sqrt()
        share = ((scale - low) / (high - low)).clamp(0.0, 1.0)
        if self.smooth:
            share = share * share * (3.0 - 2.0 * share)
        return self.stiffness_max - (self.stiffness_max - self.stiffness_min) * share

    def _scales(self) -> tuple[float, float]:
        """Bounds that were given, as standard deviations."""
        assert self.sigma_low is not None
        assert self.sigma_high is not None
        low, high = self.sigma_low, self.sigma_high
        return (math.sqrt(low), math.sqrt(high)) if self.bounds == "variance" else (low, high)

    def _quantiles(self, variances: Tensor, resolution: float = 0.0) -> tuple[float, float]:
        """Bounds as quantiles of the standard deviations along all axes."""
        if not variances.numel():
            raise InvalidParameterError(
                "covariance is empty, must have at least one matrix: bounds='quantile' takes quantiles of them."
            )
        scales = variances.clamp_min(0.0).sqrt().clamp_min(resolution).flatten().sort().values
        low, high = (_quantile(scales, share) for share in _QUANTILES)
        # Quantiles that differ by rounding only would make a step of the line between them.
        if high > low * (1.0 + checks.ROUNDING):
            return low, high
        checks.warn(
            f"The covariances do not vary: their standard deviations have quantiles {low:.3g} and {high:.3g}. "
            "Every direction counts as precise, and gets stiffness_max; give sigma_low and sigma_high with "
            "bounds='sigma' to say what is precise."
        )
        precise = max(high * (1.0 + 1e-6), _SMALLEST) if high else 1.0
        return precise, 2.0 * precise


def _quantile(ordered: Tensor, share: float) -> float:
    """Linear interpolation between order statistics, of more than the 2^24 values that ``torch.quantile`` takes."""
    place = share * (len(ordered) - 1)
    below = min(int(place), len(ordered) - 2) if len(ordered) > 1 else 0
    above = min(below + 1, len(ordered) - 1)
    low, high = float(ordered[below]), float(ordered[above])
    return low + (place - below) * (high - low)
