"""Stiffness and damping from learned variability and from its uncertainty."""

from typing import Any, NamedTuple

import numpy as np

from torch_pbd.checks import Floats
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.primitive.smoothing import UNKNOWN
from torch_pbd.estimators.door import prior_covariance

_FAR = 1e6  # distance in ranges of the input at which only the prior remains
_AT_ONCE = 2**14  # times predicted at once: a regressor may need a hundred times the memory of its predictions


class Gains(NamedTuple):
    """Stiffness and damping (n, d, d), and the covariance (n, d, d) and Type I uncertainty (n,) they come from."""

    stiffness: Floats
    damping: Floats
    covariance: Floats
    type1: Floats


def gains_at(controller: Any, time: Floats, path: Floats) -> Gains:
    """Gains of a fitted controller at movement times (n,) and desired outputs (n, d), for poses in world axes."""
    cuts = range(_AT_ONCE, len(time), _AT_ONCE)
    parts = [_gains(controller, *part) for part in zip(np.split(time, cuts), np.split(path, cuts), strict=True)]
    return Gains(*map(np.concatenate, zip(*parts, strict=True)))


def _gains(controller: Any, time: Floats, path: Floats) -> Gains:
    """Gains of the learned variability, of which a regressor bridges holes that are short beside its length scale.

    Of the share of the time that is unsampled, the covariance is therefore its prior, at the input, or if that is the
    same everywhere, far from all inputs.
    """
    regressor, phase, duration = controller.covariance_, controller.reproduction_.phase, controller.duration_
    law, mass, outputs, inputs = controller.law_, controller.mass_, controller.outputs_, phase(time)
    learned, type1 = regressor.predict_cov(inputs), regressor.predict_uncertainty(inputs).type1
    sampled = covariance = outputs.covariance(learned, path, cross_terms=law.cross_terms)
    hole = np.interp(time, np.linspace(0.0, duration, len(controller.unsampled_)), controller.unsampled_)
    if hole.any():
        prior, share = getattr(regressor, "prior", None), hole[:, np.newaxis, np.newaxis]
        if callable(prior):
            wide = prior_covariance(prior, inputs, learned.shape[-1])
        else:
            start, end = phase(np.array([0.0, duration]))
            wide = regressor.predict_cov((end + _FAR * (end - start))[np.newaxis])
        whole = (1.0 - share) * learned + share * wide
        covariance = outputs.covariance(whole, path, cross_terms=law.cross_terms)
        type1 = 1.0 - (1.0 - hole) * (1.0 - type1)
    if controller.on_unknown == "raise" and (type1 > UNKNOWN).any():
        index = int(np.argmax(type1 > UNKNOWN))
        raise ValueError(
            f"There are no data at time {time[index]:g} s: the Type I uncertainty is {type1[index]:.2f}. Ask within "
            "the demonstrations, or let on_unknown='soft' make the robot compliant there."
        )
    # The share type1 towards the least stiffness already accounts for holes; their prior would count them twice.
    stiffness = law(sampled, mass, type1=type1) if controller.on_unknown == "soft" else law(covariance, mass)
    damping = damping_from_stiffness(stiffness, mass, controller.damping_ratio)
    return Gains(stiffness.numpy(), damping.numpy(), covariance, type1)
