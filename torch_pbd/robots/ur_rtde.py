"""Schedules on Universal Robots arms by ur_rtde, from force and torque at the tool to servoed poses."""

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

# Default limits of the tool of these arms; they servo to positions, so that the stiffness is only that of the loop.
_LIMITS = RobotLimits(speed=1.0, angular_speed=3.1, stiffness=(0.0, np.inf), rotational_stiffness=(0.0, np.inf))
_ASKED = 10.0  # poses per second that the robot checks for reachability, which takes it some ms each


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
    """Follow a schedule of poses as an admittance: ``RealTimeAdmittance`` on this computer, ``servoL`` on the robot.

    The sensor is zeroed first, so that nothing may touch the tool. The arm lags by ``lookahead_time``. The apparent
    mass is the virtual mass of the schedule; less than some kg may vibrate in contact with stiff environments.

    Parameters
    ----------
    control, receive : rtde_control.RTDEControlInterface, rtde_receive.RTDEReceiveInterface
        Connected interfaces, with the schedule's tool centre point, the base as its frame, and the arm at its start.
    schedule : Schedule
        Schedule of poses in m.
    on_fault : callable, default=None
        Function called with the fault, a ``RobotStoppedError``, once the arm was stopped; None raises it.
    limits : RobotLimits, default=None
        Limits that are checked before the arm moves; None is 1 m/s and 3.1 rad/s.
    lookahead_time, gain : float, default=0.05, 300.0
        Arguments of ``servoL``, 0.03 to 0.2 s and 100 to 2000.
    **loop
        Options of ``RealTimeAdmittance``: ``force_limit``, ``deadband``, ``velocity_limit``, ``soft_start``.

    Returns
    -------
    RobotRun

    Raises
    ------
    ValueError
        Before anything moves, if the schedule exceeds the limits, is out of reach, or begins away from the arm.
    RobotStoppedError
        If the robot stops, refuses a pose, or its force or clock is lost.
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
