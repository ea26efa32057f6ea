"""Steps of a controller's fit: demonstrations from what is given, outputs, variability, the law over it, and gains."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, clone

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.matrices import damping_from_stiffness
from torch_pbd.control.primitive.outputs import RESOLUTION, Outputs, outputs_of
from torch_pbd.control.primitive.smoothing import UNKNOWN
from torch_pbd.control.stiffness import RotationLimits, StiffnessLaw
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.data.poses import ROTATION
from torch_pbd.data.units import ANGLES, LENGTHS
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.door import by_chunks, prior_covariance
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.validation import check_groups, check_squares, checked_rows, fit_with_groups

_FAR = 1e6  # distance in ranges of the input at which only the prior remains


class Gains(NamedTuple):
    """Stiffness and damping (n, d, d), and the covariance (n, d, d) and Type I uncertainty (n,) they come from."""

    stiffness: Floats
    damping: Floats
    covariance: Floats
    type1: Floats


def as_demonstrations(X: Demonstrations | ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Two or more demonstrations, as given or from samples X (n, 1), y (n, d) with labels ``groups`` (n,).

    Warns of several modes, of units that stiffness cannot have, and of timing that was removed by warping.
    """
    if isinstance(X, Demonstrations) and not (y is None and groups is None):
        raise ValueError("X is Demonstrations, which have their positions: give neither y nor groups with them.")
    demonstrations = X if isinstance(X, Demonstrations) else _grouped(X, y, groups)
    if len(demonstrations) < 2:
        raise ValueError(
            "DMPController needs >= 2 demonstrations, got 1: what varies between demonstrations cannot be learned "
            "from one. Record more, or give groups that tell the samples of several apart."
        )
    if demonstrations.suspects:
        raise ValueError(f"A controller cannot be learned of these outputs. {' '.join(demonstrations.suspects)}")
    if demonstrations.rotation_reference is not None and demonstrations.n_outputs == 3:
        raise ValueError(
            f"The demonstrations have a rotation alone, {', '.join(demonstrations.names)}, must have positions beside "
            "it: record them too."
        )
    check_unimodal(demonstrations)
    if isinstance(X, Demonstrations):  # arrays have no units: they are in m and s
        _warn_of_units(outputs_of(X.n_outputs, X.units, X.rotation_reference))
    if demonstrations.alignment == "dtw":
        checks.warn(TIMING_REMOVED)
    return demonstrations


def _warn_of_units(outputs: Outputs) -> None:
    """Warn if units of positions are missing, differ, or are neither lengths nor angles."""
    if outputs.units is None:
        checks.warn(
            "The demonstrations tell no units: positions are taken to be in m. Say so, or in what else: units='m'."
        )
    elif outputs.unit is None:
        checks.warn(
            f"The outputs are in different units, {', '.join(outputs.units)}: their principal axes mix them, and "
            "nothing is converted to m. Bring lengths, or angles, to one unit by .in_units('m'), or control them apart."
        )
    elif outputs.unit not in LENGTHS | ANGLES:
        checks.warn(
            f"The positions are in {outputs.unit!r}, which is no known length or angle "
            f"({', '.join(LENGTHS | ANGLES)}): stiffness is in N per that unit, and no limits of motion apply."
        )


def _grouped(X: ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    if y is None:
        raise ValueError("y is None: give Demonstrations, or times X (n, 1), positions y (n, d) and groups (n,).")
    times, positions = checked_rows(BaseEstimator(), X, y)
    check_squares(times, "X")
    check_squares(positions, "y")
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} columns, must have 1: the time of each sample.")
    labels = np.zeros(len(times), dtype=int) if groups is None else check_groups(groups, len(times))
    if groups is None and (back := np.diff(times[:, 0]) <= 0.0).any():
        raise ValueError(
            f"X does not increase at row {int(np.argmax(back)) + 1}: if another demonstration starts there, give "
            "groups, the number of the demonstration of each row."
        )
    names = [str(name) for name in y.columns] if hasattr(y, "columns") else None
    if set(ROTATION) <= set(names or ()):
        raise ValueError(
            f"y has columns {', '.join(ROTATION)}, as rotations of poses are called, which would count in m: give "
            "Demonstrations."
        )
    members = [labels == label for label in dict.fromkeys(labels.tolist())]
    return Demonstrations([times[m, 0] for m in members], [positions[m] for m in members], names=names)


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
                own = partial(_prior_of_coordinates, prior, inverse)
                fitted.set_params(**{name: own if callable(prior) else own(np.empty((0, 1)))})
    groups, steps = np.nonzero(known & (known.sum(axis=0) > 1))
    return fit_with_groups(fitted, inputs[steps], outputs.encode(varying[groups, steps]), groups)


def _prior_of_coordinates(prior: Any, inverse: Floats, X: Floats) -> Floats:
    """Prior at inputs X of the coordinates that are learned, from one of the outputs."""
    return inverse @ prior_covariance(prior, X, len(inverse)) @ inverse.T


def law_for(controller: Any, outputs: Outputs) -> StiffnessLaw:
    """Law of a controller, or that which it has by default; it and the mass are checked to fit the outputs."""
    law, rotates, d = controller.stiffness_law, outputs.reference is not None, len(outputs.scales)
    law = StiffnessLaw(rotation=RotationLimits() if rotates else None) if law is None else law
    if rotates != (law.rotation is not None):
        must = "limits of stiffness in Nm/rad, as the demonstrations are poses" if rotates else "None for positions"
        remedy = "give StiffnessLaw(..., rotation=RotationLimits())" if rotates else "or give Demonstrations a rotation"
        raise checks.refusal(law.rotation, "rotation of stiffness_law", must, remedy)
    law.blocks(d)
    shape = np.shape(controller.mass)
    if shape not in ((), (d, d)):
        raise ValueError(f"mass has shape {shape}, must be a number or have shape ({d}, {d}), as many as outputs.")
    return law


def fit_law(controller: Any, law: StiffnessLaw, varying: Floats) -> StiffnessLaw:
    """Law with bounds fixed to a controller's covariances of movements (K, n, d), where there are samples."""
    outputs, reproduction, unsampled = controller.outputs_, controller.reproduction_, controller.unsampled_
    time = np.linspace(0.0, controller.duration_, len(unsampled))[unsampled <= UNKNOWN][::4]
    if law.kind == "precision" and law.effort != "match":
        # The effort is in kg/N^2, the covariance in units of the recordings.
        units = outputs.scales[[block.outputs.start for block in law.blocks(len(outputs.scales))]]
        law = replace(law, effort=(units**2 * law.effort).tolist())
    learned, path = controller.covariance_.predict_cov(reproduction.phase(time)), reproduction.motion(time)[0]
    covariance = outputs.covariance(learned, path, cross_terms=law.cross_terms)
    resolution = (RESOLUTION * outputs.extents(varying)).tolist()
    return law.fitted(covariance, resolution=resolution, mass=controller.mass_)


def gains_at(controller: Any, time: Floats, path: Floats) -> Gains:
    """Gains of a fitted controller at movement times (n,) and desired outputs (n, d), for poses in world axes."""
    return Gains(*by_chunks(lambda rows: _gains(controller, time[rows], path[rows]), np.arange(len(time))))


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
