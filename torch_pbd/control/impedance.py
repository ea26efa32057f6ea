"""Learned variability of demonstrations, and stiffness and damping from it and from its uncertainty."""

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.matrices import as_damping_ratio, as_mass, damping_from_stiffness
from torch_pbd.control.primitive.outputs import RESOLUTION, Outputs, in_si
from torch_pbd.control.primitive.smoothing import UNKNOWN
from torch_pbd.control.stiffness import RotationLimits, StiffnessLaw
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor, prior_covariance
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.validation import fit_with_groups

_FAR = 1e6  # distance in ranges of the input at which only the prior remains
_NEEDED = ("get_params", "fit", "predict_cov", "predict_uncertainty")  # methods of a covariance regressor
_AT_ONCE = 2**14  # times predicted at once: a regressor may need a hundred times the memory of its predictions


def check_parameters(controller: Any) -> None:
    """Check the parameters of a DMPController before any work."""
    for name, kind in get_type_hints(type(controller)).items():
        if get_origin(kind) is Literal:
            checks.choice(getattr(controller, name), name, kind)
    for name, unit in (("alpha", ""), ("gamma", ""), ("tau", "s")):
        checks.number(getattr(controller, name), name, above=0.0, unit=unit)
    checks.number(controller.beta, "beta", above=0.0, optional=True)
    checks.number(controller.duration, "duration", above=0.0, unit="s", optional=True)
    checks.count(controller.n_steps, "n_steps", least=5)
    if controller.cutoff != "auto":
        checks.number(controller.cutoff, "cutoff", above=0.0, unit="Hz", optional=True, remedy="leave it 'auto'")
    regressor = controller.covariance
    if regressor is not None and (isinstance(regressor, type) or not all(hasattr(regressor, need) for need in _NEEDED)):
        raise checks.refusal(regressor, "covariance", "a covariance regressor, not yet fitted or fitted, or None")
    if (timing := getattr(regressor, "timing", "none")) != "none":
        raise checks.refusal(
            timing, "timing of covariance", "'none'", "a controller sets the time of its movement itself"
        )
    checks.instance(controller.stiffness_law, "stiffness_law", StiffnessLaw, optional=True)
    mass: Any = 1.0 if controller.mass is None else controller.mass
    if np.ndim(mass) < 2:
        checks.number(mass, "mass", above=0.0, unit="kg", remedy="or give a matrix (d, d)")
    as_mass(mass)
    as_damping_ratio(controller.damping_ratio)


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
    *learned, type1 = _covariances(controller, time)
    law, mass = controller.law_, controller.mass_
    if controller.on_unknown == "raise" and (type1 > UNKNOWN).any():
        index = int(np.argmax(type1 > UNKNOWN))
        raise ValueError(
            f"There are no data at time {time[index]:g} s: the Type I uncertainty is {type1[index]:.2f}. Ask within "
            "the demonstrations, or let on_unknown='soft' make the robot compliant there."
        )
    sampled, covariance = (_at_pose(controller.outputs_, law, each, path) for each in learned)
    # The share u towards the least stiffness already accounts for gaps; their prior would count them twice.
    stiffness = law(sampled, mass, type1=type1) if controller.on_unknown == "soft" else law(covariance, mass)
    damping = damping_from_stiffness(stiffness, mass, controller.damping_ratio)
    return Gains(stiffness.numpy(), damping.numpy(), covariance, type1)


def _at_pose(outputs: Outputs, law: StiffnessLaw, learned: Floats, path: Floats) -> Floats:
    """Learned covariances (n, d, d) at the poses (n, d), between blocks only if the law couples them."""
    covariance = outputs.covariance(learned, path)
    if len(outputs.blocks) == 1 or law.cross_terms:
        return covariance
    # All outputs are learned at once, but what few demonstrations say of how positions and rotations vary together does
    # not hold for others: without it, those left out are as likely, or likelier.
    cut = np.zeros_like(covariance)
    for block in outputs.blocks:
        cut[:, block, block] = covariance[:, block, block]
    return cut


def _covariances(controller: Any, time: Floats) -> tuple[Floats, Floats, Floats]:
    """Covariances (n, d, d) without and with gaps, and Type I uncertainty (n,), at times (n,).

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
    regressor: CovarianceRegressor | None,
    inputs: Floats,
    varying: Floats,
    known: NDArray[np.bool_],
    outputs: Outputs,
) -> CovarianceRegressor:
    """Clone of the regressor, fitted to movements (K, n, d) at inputs (n, 1) where two or more are known (K, n)."""
    fitted: Any = clone(HeteroscedasticGPRegressor() if regressor is None else regressor)
    between, extents = varying - varying[:1], outputs.extents(varying)
    varying = varying.copy()
    for block in outputs.blocks:
        if float(np.abs(between[..., block]).max()) <= RESOLUTION * extents[block][0]:
            # One movement, shown again: what a smooth mean leaves of it would count as variability. It stands still
            # instead, at a distance to which the floors of regressors are relative.
            varying[..., block] = extents[block] + between[..., block]
    if outputs.axes is not None:
        # Priors are of outputs, and the regressor, or one within, learns the coordinates along these axes.
        inverse: Floats = np.linalg.inv(outputs.axes).astype(np.float64)
        for name, prior in fitted.get_params(deep=True).items():
            if name.rpartition("__")[2] == "prior" and not (prior is None or isinstance(prior, str)):
                own = _PriorOfCoordinates(prior, inverse)
                fitted.set_params(**{name: own if callable(prior) else own(np.empty((0, 1)))})
    groups, steps = np.nonzero(known & (known.sum(axis=0) > 1))
    return fit_with_groups(fitted, inputs[steps], outputs.encode(varying[groups, steps]), groups)


@dataclass(frozen=True)
class _PriorOfCoordinates:
    """Prior of the coordinates that are learned, from one of the outputs that is a function of the input."""

    prior: Any
    inverse: Floats

    def __call__(self, X: Floats) -> Floats:
        return self.inverse @ prior_covariance(self.prior, X, len(self.inverse)) @ self.inverse.T


def fit_law(controller: Any, varying: Floats) -> StiffnessLaw:
    """Law of a controller with bounds fixed to the covariances of movements (K, n, d) where there are samples."""
    outputs, reproduction, unsampled = controller.outputs_, controller.reproduction_, controller.unsampled_
    time = np.linspace(0.0, controller.duration_, len(unsampled))[unsampled <= UNKNOWN][::4]
    law = _chosen(controller.stiffness_law, outputs)
    if law.kind == "precision" and law.effort != "match":
        # The effort is in kg/N^2, the covariance in units of the recordings.
        units = outputs.scales(in_si(outputs.units(controller.units_)))
        units = units[[block.outputs.start for block in law.blocks(len(units))]]
        law = replace(law, effort=(units**2 * law.effort).tolist())
    learned = controller.covariance_.predict_cov(reproduction.phase(time))
    covariance = _at_pose(outputs, law, learned, reproduction.motion(time)[0])
    resolution = (RESOLUTION * outputs.extents(varying)).tolist()
    return law.fitted(covariance, resolution=resolution, mass=outputs.mass(controller.mass))


def outputs_under(controller: Any, demonstrations: Demonstrations) -> Outputs:
    """Outputs of demonstrations, checked to fit the controller's law and mass."""
    reference, d = demonstrations.rotation_reference, demonstrations.n_outputs
    outputs = Outputs(d if reference is None else d - 3, reference)
    _chosen(controller.stiffness_law, outputs).blocks(d)
    shape = np.shape(controller.mass)
    if shape not in ((), (d, d)):
        raise ValueError(f"mass has shape {shape}, must be a number or have shape ({d}, {d}), as many as outputs.")
    return outputs


def _chosen(law: StiffnessLaw | None, outputs: Outputs) -> StiffnessLaw:
    rotates = outputs.reference is not None
    chosen = StiffnessLaw(rotation=RotationLimits() if rotates else None) if law is None else law
    if rotates != (chosen.rotation is not None):
        must = "limits of stiffness in Nm/rad, as the demonstrations are poses" if rotates else "None for positions"
        remedy = "give StiffnessLaw(..., rotation=RotationLimits())" if rotates else "or give Demonstrations a rotation"
        raise checks.refusal(chosen.rotation, "rotation of stiffness_law", must, remedy)
    return chosen
