"""Schedules on a Franka arm by franky (franky-control 2.0): impedance control with full 6 x 6 gains."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.registry import optional
from torch_pbd.robots import session
from torch_pbd.robots.session import RobotLimits, RobotRun, RobotStoppedError

_STEP = 1e-3  # s: step along the joints' motion in finite differences, whose error is its square


def run(
    robot: Any,
    schedule: Schedule,
    *,
    on_fault: Callable[[RobotStoppedError], Any] | None = None,
    limits: RobotLimits | None = None,
    period: float = 0.005,
    max_step: float = 0.1,
    settle: float = 0.5,
    gains_time_constant: float = 0.1,
    **tracker: Any,
) -> RobotRun:
    """Follow a schedule of poses with ``franky.CartesianImpedanceTracker``; the arm must be at its first pose.

    franky's controller adds Coriolis forces and the inertia times the commanded acceleration, ``a_d - J' q'``. The arm
    thus moves with its own inertia: make the schedule ``with_inertia`` of it (franky's default damping, 2 K^1/2,
    ignores mass). Deviations are clipped at ``translational_error_clip`` (0.10 m) and ``rotational_error_clip``
    (0.25 rad) per axis, beyond which the arm is softer than the schedule. Friction of 1.5 N holds the tool 30 mm away
    at 50 N/m: learn with a ``stiffness_min`` of a few hundred N/m, and pass ``friction``.

    Parameters
    ----------
    robot : franky.Robot
        Robot at rest, whose end effector is the tool and whose base is the frame of the schedule.
    schedule : Schedule
        Schedule of poses in m.
    on_fault : callable, default=None
        Function called with the fault, a ``RobotStoppedError``, once the arm was stopped; None raises it.
    limits : RobotLimits, default=None
        Limits that are checked before the arm moves; None is those of the Panda.
    period, max_step : float, default=0.005, 0.1
        Time between targets, and longest time without a new one, in s; longer is a fault.
    settle : float, default=0.5
        Time at the first row before the motion begins, in s, in which gains are reached.
    gains_time_constant : float, default=0.1
        Time constant of franky's gain filter in s, ahead of which gains are sent.
    **tracker
        Options of ``franky.CartesianImpedanceTracker``: ``posture_task``, ``friction``, clips, ``max_delta_tau``.

    Returns
    -------
    RobotRun

    Warns
    -----
    UserWarning
        If the schedule was not made ``with_inertia`` of an arm.

    Raises
    ------
    ValueError
        Before anything moves, if the schedule exceeds the limits or begins away from the arm.
    RobotStoppedError
        If the arm stops by itself, the connection breaks, or a target comes late.
    """
    franky = optional("franky", "robot", "a Franka arm")
    session.check_limits(schedule, RobotLimits() if limits is None else limits)
    session.warn_of_mass(schedule)
    checks.number(period, "period", above=0.0, below=max_step, unit="s")
    # A target holds for a period; taken at its middle, it is never more than half a period from the motion.
    rows = schedule.resample(times=np.arange(schedule.time[0] + 0.5 * period, schedule.time[-1], period))
    gains, targets = _planned(franky, rows)
    acceleration, ahead, model = session.accelerations(rows), round(gains_time_constant / period), robot.model
    start = robot.current_pose.end_effector_pose
    session.check_start(schedule, start.translation, np.roll(start.quaternion, 1))
    passed: list[tuple[float, Any, Any]] = []
    tracking = franky.CartesianImpedanceTracker(
        robot, gains=gains[0], gains_time_constant=gains_time_constant, period=period, **tracker
    )
    with session.stopping(tracking.stop, on_fault):
        last = robot.state.time.to_sec()
        origin = last + settle - schedule.time[0]
        while tracking.tick() is not None:
            state = robot.state
            now, pose = state.time.to_sec(), state.O_T_EE
            if now - last > max_step:
                raise RobotStoppedError(f"no target came for {now - last:.3g} s, must come within {max_step:g} s")
            last = now
            row = math.floor((now - origin - schedule.time[0]) / period + 1e-6)  # times are whole milliseconds
            if row >= len(rows):
                break
            if row >= 0:
                passed.append((now - origin, pose.translation, np.roll(pose.quaternion, 1)))
                tracking.set_gains(gains=gains[min(row + ahead, len(rows) - 1)])
                # The controller commands J q'' only, so that the bias J' q' is subtracted.
                rise = franky.TwistAcceleration(*np.split(acceleration[row] - _bias(franky, model, state), 2))
                tracking.set_target(*targets[row], rise)
        else:
            raise RobotStoppedError("the arm is no longer under control: it met a limit, or somebody stopped it")
    return session.recorded(schedule, passed)


def _planned(franky: Any, rows: Schedule) -> tuple[list[Any], list[tuple[Any, Any]]]:
    """Gains, and poses with their twists, for all rows."""
    gains = [franky.CartesianImpedanceGains() for _ in rows.time]
    for own, stiffness, damping in zip(gains, rows.stiffness, rows.damping, strict=True):
        own.stiffness, own.damping = stiffness, damping
    position, orientation = session.poses(rows)
    moves = zip(position, np.roll(orientation, -1, axis=1), rows.velocity, strict=True)
    return gains, [(franky.Affine(place, turn), franky.Twist(*np.split(pace, 2))) for place, turn, pace in moves]


def _bias(franky: Any, model: Any, state: Any) -> Floats:
    """Acceleration J' q' (6,) of the tool at constant joint speeds, by differences of J along q'."""
    ahead, behind = (
        model.zero_jacobian(franky.Frame.EndEffector, state.q + step * state.dq, state.F_T_EE, state.EE_T_K)
        for step in (_STEP, -_STEP)
    )
    return np.asarray((ahead - behind) @ state.dq / (2.0 * _STEP))
