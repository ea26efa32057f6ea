"""Schedules on arms of Universal Robots by ur_rtde: force and torque at the tool in, poses to servo to out."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.realtime import RealTimeAdmittance, TickStatus
from torch_pbd.control.schedule import Schedule
from torch_pbd.robots import session
from torch_pbd.robots.session import RobotLimits, RobotRun, RobotStoppedError

# Limits of the tool as these arms are delivered; they servo to positions, so that stiffness is a matter of the loop.
_LIMITS = RobotLimits(speed=1.0, angular_speed=3.1, stiffness=(0.0, np.inf), rotational_stiffness=(0.0, np.inf))
_ASKED = 10.0  # poses a second of which the robot is asked whether it reaches them: each takes it some ms


def run(
    control: Any,
    receive: Any,
    schedule: Schedule,
    *,
    on_fault: Callable[[RobotStoppedError], Any] | None = None,
    limits: RobotLimits | None = None,
    lookahead_time: float = 0.05,
    gain: float = 300.0,
    **loop: Any,
) -> RobotRun:
    """Follow a schedule of poses as an admittance: ``RealTimeAdmittance`` here, ``servoL`` there.

    The sensor is zeroed first: nothing may touch the tool. The arm lags ``lookahead_time`` behind; what the tool feels
    is the virtual mass of the schedule, of which less than some kg may shake in contact with what is stiff.

    Parameters
    ----------
    control, receive : rtde_control.RTDEControlInterface, rtde_receive.RTDEReceiveInterface
        Connected, the tool centre point that of the schedule, the robot's base its frame, the arm at its first pose.
    schedule : Schedule
        Poses, in m.
    on_fault : callable, default=None
        Called with the fault, a ``RobotStoppedError``, once the arm was stopped; None raises it.
    limits : RobotLimits, default=None
        Limits that are checked before the arm moves; None is 1 m/s and 3.1 rad/s. The robot is asked whether it can
        come there.
    lookahead_time, gain : float, default=0.05, 300.0
        Arguments of ``servoL``: 0.03 to 0.2 s, 100 to 2000.
    **loop
        Options of ``RealTimeAdmittance``: ``force_limit``, ``deadband``, ``velocity_limit``, ``soft_start``.

    Returns
    -------
    RobotRun
        The motion as far as it came.

    Raises
    ------
    ValueError
        Before anything moves: if the schedule is beyond the limits or out of reach, or the arm elsewhere.
    RobotStoppedError
        If the robot stops, refuses a pose, or its force or clock are lost.
    """
    session.check_limits(schedule, _LIMITS if limits is None else limits)
    checks.number(lookahead_time, "lookahead_time", least=0.03, most=0.2, unit="s")
    checks.number(gain, "gain", least=100.0, most=2000.0)
    asked = schedule.resample(min(_ASKED, len(schedule) / schedule.duration))
    for at, position, orientation in zip(asked.time, *session.poses(asked), strict=True):
        if not control.isPoseWithinSafetyLimits(_pose(position, orientation)):
            raise checks.refusal(position.tolist(), f"the position at {at:.4g} s", "within the robot's safety limits")
    step = control.getStepTime()
    admittance = RealTimeAdmittance(schedule, rate=1.0 / step, **loop)
    here = np.array(receive.getActualTCPPose())
    session.check_start(schedule, here[:3], rotations.exp(here[3:]))
    control.zeroFtSensor()
    passed: list[tuple[float, Floats, Floats]] = []
    with session.stopping(control.servoStop, on_fault):
        admittance.start(time.monotonic(), here[:3], orientation=rotations.exp(here[3:]))
        while admittance.schedule_time < schedule.duration:
            period = control.initPeriod()
            if receive.isProtectiveStopped() or receive.isEmergencyStopped():
                raise RobotStoppedError("the robot is in a protective or an emergency stop")
            if admittance.tick(time.monotonic(), receive.getActualTCPForce()) & TickStatus.STOPPED:
                raise RobotStoppedError(f"the loop stopped, its faults were {admittance.faults}")
            target = _pose(np.array(admittance.position), np.array(admittance.orientation))
            if not control.servoL(target, 0.0, 0.0, step, lookahead_time, gain):
                raise RobotStoppedError("the robot refused a pose: its program has ended, or the connection")
            here = np.array(receive.getActualTCPPose())
            passed.append((schedule.time[0] + admittance.schedule_time, here[:3], rotations.exp(here[3:])))
            control.waitPeriod(period)
    return session.recorded(schedule, passed)


def _pose(position: Floats, orientation: Floats) -> list[float]:
    """Position and rotation vector, as the robot's base has them."""
    return [*position.tolist(), *rotations.log(orientation).tolist()]
