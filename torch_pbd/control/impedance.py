"""Variability of demonstrations, learned; and stiffness and damping from what is known of it, and what is not."""

from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.checks import Floats
from torch_pbd.control.damping import damping_from_stiffness
from torch_pbd.control.primitive.smoothing import UNKNOWN
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.demonstrations import fit_with_groups
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.validation import prior_covariance

OnUnknown = Literal["soft", "prior", "raise"]

_RESOLUTION = 1e-5  # of the extent of a movement: smaller standard deviations count as none
_ROUNDING = 1e-11  # of the largest position
_FAR = 1e6  # ranges of the input: only the prior speaks there
_AT_ONCE = 2**14  # times: a regressor may need a hundred times the memory of what it predicts


class Gains(NamedTuple):
    """Stiffness and damping (n, d, d), and the covariance (n, d, d) and Type I uncertainty (n,) they come from."""

    stiffness: Floats
    damping: Floats
    covariance: Floats
    type1: Floats


def gains_at(controller: Any, time: Floats) -> Gains:
    """Gains of a fitted :class:`~torch_pbd.control.DMPController` at movement times (n,).

    Raises
    ------
    ValueError
        With on_unknown="raise", if the Type I uncertainty is above 0.5 somewhere.
    """
    parts = [_gains(controller, part) for part in np.split(time, range(_AT_ONCE, len(time), _AT_ONCE))]
    return Gains(*map(np.concatenate, zip(*parts, strict=True)))


def _gains(controller: Any, time: Floats) -> Gains:
    sampled, covariance, type1 = _covariances(controller, time)
    on_unknown, law = controller.on_unknown, controller.law_
    if on_unknown == "raise" and (type1 > UNKNOWN).any():
        index = int(np.argmax(type1 > UNKNOWN))
        raise ValueError(
            f"There are no data at time {time[index]:g}: the Type I uncertainty is {type1[index]:.2f}. Ask within "
            "the demonstrations, or let on_unknown='soft' make the robot compliant there."
        )
    if on_unknown == "soft":
        # The share u of the way to the least stiffness counts holes already; their prior would count them again.
        stiffness = law(sampled)
        softest = stiffness.new_tensor(law.limits(stiffness.shape[-1])[0]) * torch.eye(stiffness.shape[-1]).to(
            stiffness
        )
        stiffness = softest + torch.tensor(1.0 - type1)[:, None, None] * (stiffness - softest)
    else:
        stiffness = law(covariance)
    damping = damping_from_stiffness(stiffness, float(controller.mass), controller.damping_ratio)
    return Gains(stiffness.numpy(), damping.numpy(), covariance, type1)


def _covariances(controller: Any, time: Floats) -> tuple[Floats, Floats, Floats]:
    """Covariances (n, d, d) without and with holes, and Type I uncertainty (n,), at times (n,).

    A regressor bridges holes that are short beside its length scale. Of the share of the time that is unsampled,
    the covariance is therefore its prior, at the input, or if that is the same everywhere, far from all inputs.
    """
    regressor, phase, duration = controller.covariance_, controller.reproduction_.phase, controller.duration_
    hole = np.interp(time, np.linspace(0.0, duration, len(controller.unsampled_)), controller.unsampled_)
    inputs = phase(time)
    sampled, type1 = regressor.predict_cov(inputs), regressor.predict_uncertainty(inputs).type1
    if not hole.any():
        return sampled, sampled, type1
    prior, share = getattr(regressor, "prior", None), hole[:, np.newaxis, np.newaxis]
    if callable(prior):
        wide = prior_covariance(prior, inputs, sampled.shape[-1])
    else:
        start, end = phase(np.array([0.0, duration]))
        wide = regressor.predict_cov((end + _FAR * (end - start))[np.newaxis])
    return sampled, (1.0 - share) * sampled + share * wide, 1.0 - (1.0 - hole) * (1.0 - type1)


def fit_covariance(
    regressor: CovarianceRegressor | None, inputs: Floats, varying: Floats, known: NDArray[np.bool_]
) -> CovarianceRegressor:
    """Clone of the regressor, fitted to what varies (K, n, d) at inputs (n, 1), where two or more know it (K, n).

    From one demonstration alone nothing is known of how they vary, and the others stay aligned.
    """
    fitted: CovarianceRegressor = clone(HeteroscedasticGPRegressor() if regressor is None else regressor)
    between, extent = varying - varying[:1], _extent(varying)
    if float(np.abs(between).max()) <= _RESOLUTION * extent:
        # One movement, shown again: what a smooth mean leaves of it would count as variability. It stands still
        # instead, at a distance to which the floors of regressors are relative.
        varying = extent + between
    groups, steps = np.nonzero(known & (known.sum(axis=0) > 1))
    return fit_with_groups(fitted, inputs[steps], varying[groups, steps], groups)


def fit_law(law: StiffnessLaw | None, covariance: Floats, varying: Floats) -> StiffnessLaw:
    """Law with its bounds fixed to covariances (m, d, d) along a movement, of what varies (K, n, d)."""
    return (StiffnessLaw() if law is None else law).fitted(covariance, resolution=_RESOLUTION * _extent(varying))


def _extent(varying: Floats) -> float:
    """Diagonal of the box around (K, n, d); where nothing moves the largest position, which floors are relative to."""
    extent, largest = float(np.linalg.norm(np.ptp(varying, axis=(0, 1)))), float(np.abs(varying).max())
    return extent if extent > _ROUNDING * largest else largest or 1.0
