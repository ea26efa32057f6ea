"""Checks of a controller's parameters and demonstrations."""

import math
from collections.abc import Sequence
from typing import Any, Literal, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator

from torch_pbd import checks
from torch_pbd.control.matrices import as_damping_ratio, as_mass
from torch_pbd.control.primitive.outputs import common_unit
from torch_pbd.control.primitive.smoothing import CUTOFF_HZ
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.data.poses import ROTATION
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES
from torch_pbd.estimators.validation import check_groups, check_squares, checked_rows
from torch_pbd.files.memory import require_much

_BRIEFEST = 1e-100  # s: squares of what is briefer, or of its inverse, are no numbers
_CYCLES = 0.01, 1e6  # of the cutoff in a movement: fewer smooth it to a line, more leave what was recorded
# Time constants in a movement. A reach of 0.6 m is reproduced to 0.1 mm with 1e10 of alpha; rounding of the spring's
# force moves it by 41 mm with 1e13, and out of its range with 1e16; so does the forcing, integrated twice, with 0.01.
# With 0.02 of alpha, or 0.01 of the gamma of a gate, an additive movement is at rest a hundred durations late.
_CONSTANTS, _GATE_CONSTANTS = (0.02, 1e12), (0.01, math.inf)
# The phase must tell times apart: exp(-30) is 1e-13, and 1e-6 leaves ten digits. Its logarithm is time in other units.
_DECAY = {"s": (1e-6, 30.0), "log_s": (1e-6, 1e12)}
# Measured, in numbers: of each of a demonstration's positions while it is smoothed; of each pair of steps while the
# forcing is learned, in all and of each axis where they are many; of each axis at a step, while it is tabulated.
_SMOOTHED, _PAIRED, _PAIRED_AXIS, _TABULATED = 10.0, 34.0, 5.0, 16e3
_NEEDED = ("get_params", "fit", "predict_cov", "predict_uncertainty")


def check_parameters(controller: Any) -> None:
    """Refuse the parameters of a DMPController that cannot be used, before any work."""
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


def check_against_duration(controller: Any) -> None:
    """Refuse parameters that only the duration of the movement makes too small or too large."""
    dmp, duration, cutoff = controller.dmp_, controller.duration_, controller.cutoff_
    checks.number(duration, "duration", least=_BRIEFEST, most=1.0 / _BRIEFEST, unit="s")
    if cutoff is not None and not _CYCLES[0] <= cutoff * duration <= _CYCLES[1]:
        # Where the automatic one too would be out of range, the times are in another unit than they say.
        suspect = controller.cutoff == "auto" or CUTOFF_HZ * duration > _CYCLES[1]
        units = f"the unit of the times is suspect, time_unit={controller.time_unit_!r} (known: {', '.join(TIMES)})"
        remedy = units if suspect else "leave it 'auto'"
        raise ValueError(
            f"cutoff is {cutoff:g} Hz, {cutoff * duration:.3g} cycles in a movement of {duration:.3g} s, must be "
            f"{_CYCLES[0]:g} to {_CYCLES[1]:g} of them: {remedy}."
        )
    ranges = [("alpha", dmp.alpha, _CONSTANTS), ("beta", math.sqrt(dmp.alpha) * math.sqrt(dmp.beta), (0.0, 1e12))]
    ranges += [("gamma", dmp.gamma, _GATE_CONSTANTS)] if dmp.gate == "phase" else []
    ranges += [("gamma", dmp.gamma, _DECAY[controller.phase_input])] if controller.phase_input != "time" else []
    for name, rate, (least, most) in ranges:
        constants = rate * duration / dmp.tau
        if not least <= constants <= most:
            raise ValueError(
                f"{name} is {getattr(dmp, name):g} and tau is {dmp.tau:g} s, {constants:.3g} time constants in a "
                f"movement of {duration:.3g} s, must be {least:g} to {most:g} of them with gate={dmp.gate!r}, "
                f"phase_input={controller.phase_input!r}: leave them as they are by default."
            )


def as_demonstrations(X: Demonstrations | ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Two demonstrations or more: as they are, or of samples X (n, 1), y (n, d) whose groups (n,) tell them apart.

    Warns of more than one way, of units that stiffness cannot have, and of timing that was taken out by warping.
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
        _warn_of_units(X.units if X.units is None or X.rotation_reference is None else X.units[:-3])
    if demonstrations.alignment == "dtw":
        checks.warn(TIMING_REMOVED)
    return demonstrations


def _warn_of_units(units: Sequence[str] | None) -> None:
    """Warn of what becomes of positions whose units are not given, differ, or are no lengths and no angles."""
    common = common_unit(units)
    if units is None:
        checks.warn(
            "The demonstrations tell no units: positions are taken to be in m. Say so, or in what else: units='m'."
        )
    elif common is None:
        checks.warn(
            f"The outputs are in different units, {', '.join(units)}: their principal axes mix them, and nothing is "
            "converted to m. Bring them to one unit, or control them apart."
        )
    elif common not in LENGTHS | ANGLES:
        checks.warn(
            f"The positions are in {common!r}, which is no known length or angle ({', '.join(LENGTHS | ANGLES)}): "
            "stiffness is in N per that unit, and no limits of motion apply."
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


def check_steps(n_steps: int, n_demos: int, d: int, *, learned: bool) -> None:
    """Refuse more points of a movement than fit in memory: smoothed, and for a fit with the forcing of them learned."""
    n = float(n_steps)
    needed = _SMOOTHED * n * n_demos * d
    if learned:  # Gaussian processes have matrices of all pairs of points, unless a few nodes carry the forcing
        needed += n * (max(_PAIRED, _PAIRED_AXIS * d) * n + _TABULATED * d)
    require_much(
        8.0 * needed,
        what=f"n_steps={n_steps} of {n_demos} demonstrations of {d} axes",
        remedy="Lower n_steps: 100 to 500 follow most movements.",
    )
