"""Schedules on robosuite (1.5) arms by its operational space controller, which imposes unit mass."""

from typing import Any

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.robots.session import RobotLimits, accelerations, check_limits, poses

CONTROLLER: dict[str, Any] = {
    "type": "OSC_POSE",
    "impedance_mode": "variable",
    "input_type": "absolute",
    "input_ref_frame": "world",
    "uncouple_pos_ori": False,
    "kp": 150,
    "damping_ratio": 1,
    "kp_limits": [0, 3000],
    "damping_ratio_limits": [0, 10],
    "interpolation": None,
}
"""Settings of an arm's controller that `to_actions` is for: ``controller_configs["body_parts"]["right"]``."""

# Limits of the motion alone; gains are checked against those of CONTROLLER, to which robosuite clips silently.
_LIMITS = RobotLimits(stiffness=(0.0, np.inf), rotational_stiffness=(0.0, np.inf))


def to_actions(schedule: Schedule, control_freq: float = 20.0) -> Floats:
    """Actions (n, 18) for ``env.step`` with the ``CONTROLLER``: damping ratios, kp, position, rotation vector.

    The controller's wrench is ``Lambda (kp e - kd v)``, kp in 1/s^2: the arm moves as a unit mass, so that a schedule
    for 1 kg (and 1 kg m^2) applies unchanged, and its certificate holds. Goals lead by ``(D v_d + a_d) / K``, as the
    controller has no desired velocity. Its rotation error is sin(theta) along the axis.

    Parameters
    ----------
    schedule : Schedule
        Schedule of poses in m and world axes, with a scalar mass, or none, which counts as 1 kg.
    control_freq : float, default=20.0
        Actions per second of the environment.

    Warns
    -----
    UserWarning
        If stiffness or damping are not diagonal, since the controller takes only their diagonals.

    Raises
    ------
    ValueError
        If the schedule was made with the inertia of an arm, or its gains exceed the controller's limits.
    """
    check_limits(schedule, _LIMITS)
    if isinstance(schedule.mass, np.ndarray):
        raise InvalidParameterError(
            "schedule has an inertia of several numbers, as that of an arm, which this controller takes out: give "
            "schedule.with_inertia(1.0)."
        )
    whole = schedule.resample(checks.number(control_freq, "control_freq", above=0.0, unit="Hz"))
    rows, loss = whole.diagonal()
    if (rows.stiffness != whole.stiffness).any():
        checks.warn(f"{loss}.")
    position, orientation = poses(rows)
    mass = 1.0 if rows.mass is None else rows.mass
    stiffness, damping = (np.diagonal(gain, axis1=1, axis2=2) / mass for gain in (rows.stiffness, rows.damping))
    good = (stiffness > 0.0) & (stiffness <= CONTROLLER["kp_limits"][1])
    checks.require(good, stiffness, "kp", "above zero and at most 3000 1/s^2", "learn with a smaller stiffness_max")
    ratio, most = 0.5 * damping / np.sqrt(stiffness), CONTROLLER["damping_ratio_limits"][1]
    good = ratio <= most * (1.0 + checks.ROUNDING)
    checks.require(
        good, ratio, "damping_ratio", f"at most {most}", "give schedule.with_inertia(1.0, damping_ratio=1.0)"
    )
    ahead = (damping * rows.velocity + accelerations(rows)) / stiffness
    turned = rotations.log(rotations.multiply(rotations.exp(ahead[:, 3:]), orientation))
    return np.hstack([ratio, stiffness, position + ahead[:, :3], turned])
