"""Stiffness from covariance: eq. (19) and (20)."""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any, Literal, final, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.matrices import as_semidefinite, check_finite, check_flag
from torch_pbd.linalg import spectral_map

Bounds = Literal["quantile", "sigma", "variance"]
_QUANTILES = (0.1, 0.9)
_SMALLEST = 1e-150  # deviation whose square is a number


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

    Raises
    ------
    ValueError
        If a parameter is not as described.

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
        check_flag("smooth", self.smooth)
        if self.bounds not in get_args(Bounds):
            raise ValueError(f"bounds is {self.bounds!r}, must be one of {', '.join(map(repr, get_args(Bounds)))}.")
        for name in ("stiffness_min", "stiffness_max", "sigma_low", "sigma_high"):
            check_finite(name, getattr(self, name), optional=name.startswith("sigma"))
        if not 0.0 < self.stiffness_min <= self.stiffness_max:
            raise ValueError(
                f"stiffness_min={self.stiffness_min:g} and stiffness_max={self.stiffness_max:g} N/m, must be "
                "0 < stiffness_min <= stiffness_max."
            )
        given = [value for value in (self.sigma_low, self.sigma_high) if value is not None]
        if self.bounds == "quantile" and given:
            raise ValueError(
                f"sigma_low={self.sigma_low} and sigma_high={self.sigma_high} are standard deviations: give "
                "bounds='sigma' with them (or 'variance'). bounds='quantile' takes its own from the covariances."
            )
        if self.bounds != "quantile" and (self.sigma_low is None or self.sigma_high is None):
            raise ValueError(
                f"bounds={self.bounds!r} needs sigma_low and sigma_high, got {self.sigma_low}, {self.sigma_high}. "
                "Give both, or let bounds='quantile' take them from the covariances."
            )
        if given and not 0.0 <= given[0] < given[1]:
            raise ValueError(
                f"sigma_low={given[0]:g} and sigma_high={given[1]:g}, must be 0 <= sigma_low < sigma_high."
            )

    def __call__(self, covariance: Float[Tensor, "*b d d"] | Any) -> Float[Tensor, "*b d d"]:
        """Stiffness in N/m of covariances (..., d, d), symmetric to the last bit.

        Raises
        ------
        ValueError
            If a covariance is not finite, symmetric and positive semidefinite.
        """
        matrix = as_semidefinite(covariance, "covariance")
        low, high = self._resolved(matrix)
        return spectral_map(matrix, lambda variance: self._of_scale(variance.clamp_min(0.0), low, high))

    def fitted(self, covariance: Float[Tensor, "*b d d"] | Any, *, resolution: float = 0.0) -> "StiffnessLaw":
        """The same law with its bounds fixed, as standard deviations, to those of ``covariance`` (..., d, d).

        Quantiles take standard deviations below ``resolution``, which cannot be told from zero, for that.
        With bounds="quantile" and covariances that do not vary at all, every axis counts as precise, and a
        warning says so.
        """
        check_finite("resolution", resolution)
        if resolution < 0.0:
            raise ValueError(f"resolution is {resolution:g}, must not be negative.")
        low, high = self._resolved(as_semidefinite(covariance, "covariance"), float(resolution))
        return replace(self, sigma_low=low, sigma_high=high, bounds="sigma")

    def lipschitz(self) -> float:
        """Largest change of the stiffness for a change of the covariance, both in the Frobenius norm.

        Of a law with bounds="sigma" or "variance": (k_max - k_min) / (s_high - s_low) / (2 s_low), half as much
        again if ``smooth`` (F. Kittaneh, Linear Algebra and its Applications 71, 1985, of spectral functions).
        """
        if self.bounds == "quantile":
            raise ValueError("bounds == 'quantile' depends on the covariances: call fitted(covariance) first.")
        low, high = self._scales()
        slope = (self.stiffness_max - self.stiffness_min) / (high - low) / (2.0 * low) if low else math.inf
        return 1.5 * slope if self.smooth else slope

    def _of_scale(self, variance: Tensor, low: float, high: float) -> Tensor:
        # The root is taken of what is above the lower bound, so its gradient at zero is never asked for.
        scale = variance.clamp_min(max(low**2, torch.finfo(variance.dtype).tiny)).sqrt()
        share = ((scale - low) / (high - low)).clamp(0.0, 1.0)
        if self.smooth:
            share = share * share * (3.0 - 2.0 * share)
        return self.stiffness_max - (self.stiffness_max - self.stiffness_min) * share

    def _scales(self) -> tuple[float, float]:
        assert self.sigma_low is not None
        assert self.sigma_high is not None
        low, high = self.sigma_low, self.sigma_high
        return (math.sqrt(low), math.sqrt(high)) if self.bounds == "variance" else (low, high)

    def _resolved(self, covariance: Tensor, resolution: float = 0.0) -> tuple[float, float]:
        """Bounds as standard deviations."""
        if self.bounds != "quantile":
            return self._scales()
        if not covariance.numel():
            raise ValueError("bounds == 'quantile' needs at least one covariance to take the quantiles of; got none.")
        scales = (
            torch.linalg.eigvalsh(covariance.detach())
            .clamp_min(0.0)
            .sqrt()
            .clamp_min(resolution)
            .flatten()
            .sort()
            .values
        )
        low, high = (_quantile(scales, share) for share in _QUANTILES)
        if high <= low * (1.0 + 1e-9):
            warnings.warn(
                f"The covariances do not vary: their standard deviations have quantiles {low:.3g} and {high:.3g}. "
                "Every direction counts as precise, and gets stiffness_max; give sigma_low and sigma_high with "
                "bounds='sigma' to say what is precise.",
                stacklevel=3,
            )
            precise = max(high * (1.0 + 1e-6), _SMALLEST) if high else 1.0
            return precise, 2.0 * precise
        return low, high


def _quantile(ordered: Tensor, share: float) -> float:
    """Linear interpolation between order statistics; ``torch.quantile`` refuses more than 2^24 values."""
    place = share * (len(ordered) - 1)
    below = min(int(place), len(ordered) - 2) if len(ordered) > 1 else 0
    above = min(below + 1, len(ordered) - 1)
    low, high = float(ordered[below]), float(ordered[above])
    return low + (place - below) * (high - low)
