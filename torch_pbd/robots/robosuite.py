"""Schedules on arms of robosuite (1.5) by its operational space controller, made for unit mass."""

from collections.abc import Callable
from typing import Any

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.robots.session import (
    RobotLimits,
    RobotRun,
    RobotStoppedError,
    check_limits,
    check_start,
    poses,
    recorded,
    stopping,
)

CONTROLLER = {
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

# robosuite clips to the limits of its controller, without a word; these are those above.
_LIMITS = RobotLimits(stiffness=(0.0, 3000.0), rotational_stiffness=(0.0, 3000.0))


def to_actions(schedule: Schedule, control_freq: float = 20.0) -> Floats:
    """Actions (n, 18) of the controller, at its frequency in Hz: damping ratios, kp, position, rotation vector.

    The controller's wrench is ``Lambda (kp e - kd v)``, kp in 1/s^2: the arm moves as a unit mass, so that a schedule
    of 1 kg (and 1 kg m^2) is right as it is, and its certificate holds. Goals lead by ``(D v_d + a_d) / K``, as the
    controller knows no desired velocity. Its rotation error is sin(theta) along the axis.

    Parameters
    ----------
    schedule : Schedule
        Of poses, in m and world axes, with a mass of one number or none, which counts as 1 kg.
    control_freq : float, default=20.0
        Of the environment.

    Warns
    -----
    UserWarning
        Of what the diagonals of stiffness and damping lose: the controller takes no more.

    Raises
    ------
    ValueError
        If the schedule was made with the inertia of an arm, or its gains are beyond what the controller takes.
    """
    check_limits(schedule, _LIMITS)
    if isinstance(schedule.mass, np.ndarray):
        raise InvalidParameterError(
            "schedule has the inertia of an arm, which this controller takes out: give schedule.with_inertia(1.0)."
        )
    rows, loss = schedule.resample(checks.number(control_freq, "control_freq", above=0.0, unit="Hz")).diagonal()
    if loss.stiffness_max > 0.0:
        checks.warn(f"{loss}.")
    position, orientation = poses(rows)
    mass = 1.0 if rows.mass is None else rows.mass
    stiffness, damping = (np.diagonal(gain, axis1=1, axis2=2) / mass for gain in (rows.stiffness, rows.damping))
    checks.require(stiffness > 0.0, stiffness, "the diagonal of stiffness", "above zero")
    ahead = damping * rows.velocity
    ahead += np.gradient(rows.velocity, rows.time, axis=0) if rows.acceleration is None else rows.acceleration
    ahead /= stiffness
    turned = rotations.log(rotations.multiply(rotations.exp(ahead[:, 3:]), orientation))
    return np.hstack([0.5 * damping / np.sqrt(stiffness), stiffness, position + ahead[:, :3], turned])


def run(
    env: Any,
    schedule: Schedule,
    *,
    on_fault: Callable[[RobotStoppedError], Any] | None = None,
    limits: RobotLimits | None = None,
    arm: str = "right",
) -> RobotRun:
    """Follow a schedule in an environment of one robot whose arm has the :data:`CONTROLLER`; other parts rest.

    Parameters
    ----------
    env : robosuite environment
        After ``reset``, the arm at the first pose.
    schedule : Schedule
        As for `to_actions`.
    on_fault : callable, default=None
        Told the fault, a `RobotStoppedError`; None raises it.
    limits : RobotLimits, default=None
        Of the motion, checked before the first step; None is what the controller takes.
    arm : str, default="right"

    Returns
    -------
    RobotRun
        As far as it came.

    Raises
    ------
    ValueError
        Before the first step: if the schedule is beyond the limits, or the arm elsewhere.
    RobotStoppedError
        If the simulation ends or fails.
    """
    check_limits(schedule, _LIMITS if limits is None else limits)
    actions = to_actions(schedule, env.control_freq)
    robot, times = env.robots[0], schedule.resample(env.control_freq).time
    part = robot.composite_controller._action_split_indexes[arm]
    passed: list[tuple[float, Floats, Floats]] = []
    check_start(schedule, *_pose(env, robot, arm))
    with stopping(lambda: None, on_fault):
        for time, action in zip(times, actions, strict=True):
            passed.append((time, *_pose(env, robot, arm)))
            whole = np.zeros(env.action_dim)
            whole[slice(*part)] = action
            env.step(whole)
    return recorded(schedule, passed)


def _pose(env: Any, robot: Any, arm: str) -> tuple[Floats, Floats]:
    site = robot.eef_site_id[arm]
    turn = np.reshape(env.sim.data.site_xmat[site], (3, 3))
    return np.array(env.sim.data.site_xpos[site]), rotations.from_matrix(turn)
