"""Sessions with robots: checks before the first tick, and a guaranteed stop at the end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import Schedule
from torch_pbd.exceptions import InvalidParameterError

_NEAR, _TURNED = 0.01, 0.05  # largest distance in m and rad of the first pose from the robot


class RobotStoppedError(RuntimeError):
    """Error of a robot that could not continue and was stopped."""


@final
@dataclass(frozen=True)
class RobotLimits:
    """Limits of a robot; a schedule that exceeds them raises an error before the first tick.

    Defaults are those of the Franka Panda's interface.

    Parameters
    ----------
    speed, acceleration : float, default=1.7, 13.0
        Largest speed and acceleration of the tool in m/s and m/s^2.
    angular_speed, angular_acceleration : float, default=2.5, 25.0
        Largest angular speed and acceleration of the tool in rad/s and rad/s^2.
    stiffness, rotational_stiffness : (float, float), default=(10.0, 3000.0), (1.0, 300.0)
        Smallest and largest eigenvalue of the stiffness blocks in N/m and Nm/rad.
    """

    speed: float = 1.7
    acceleration: float = 13.0
    angular_speed: float = 2.5
    angular_acceleration: float = 25.0
    stiffness: tuple[float, float] = (10.0, 3000.0)
    rotational_stiffness: tuple[float, float] = (1.0, 300.0)


def poses(schedule: Any) -> tuple[Floats, Floats]:
    """Positions (n, 3) in m and orientations (n, 4) of a schedule that has both."""
    checks.instance(schedule, "schedule", Schedule)
    if schedule.orientation is None or schedule.position.shape[1] != 3 or schedule.units not in (None, "m"):
        raise InvalidParameterError(
            f"schedule has {schedule.n_outputs} outputs in {schedule.units}, must have positions (n, 3) in m and "
            "orientations (n, 4): learn from demonstrations with rotation=, or give Schedule(..., orientation=)."
        )
    return schedule.position, schedule.orientation


def accelerations(schedule: Schedule) -> Floats:
    """Planned accelerations (n, d), by default the differences of the schedule's velocities."""
    if schedule.acceleration is not None:
        return schedule.acceleration
    return np.gradient(schedule.velocity, schedule.time, axis=0)


def check_limits(schedule: Schedule, limits: Any) -> None:
    """Check a schedule of poses against limits; the error names the row."""
    poses(schedule)
    checks.instance(limits, "limits", RobotLimits)
    for field, values, block, unit in (
        ("speed", schedule.velocity, slice(3), "m/s"),
        ("angular_speed", schedule.velocity, slice(3, 6), "rad/s"),
        ("acceleration", schedule.acceleration, slice(3), "m/s^2"),
        ("angular_acceleration", schedule.acceleration, slice(3, 6), "rad/s^2"),
    ):
        if values is not None:
            length, most = np.linalg.norm(values[:, block], axis=1), getattr(limits, field)
            what, must = f"the {field.replace('_', ' ')}", f"at most RobotLimits.{field}, {most:g} {unit}"
            checks.require(length <= most, length, what, must, "slow down: retime it", unit)
    for block, field, unit in ((slice(3), "stiffness", "N/m"), (slice(3, 6), "rotational_stiffness", "Nm/rad")):
        low, high = getattr(limits, field)
        eigenvalues = np.linalg.eigvalsh(schedule.stiffness[:, block, block])
        slack = checks.ROUNDING * high
        good = (eigenvalues >= low - slack) & (eigenvalues <= high + slack)
        must = f"within RobotLimits.{field}, {low:g} to {high:g} {unit}"
        checks.require(good, eigenvalues, "the eigenvalue of stiffness", must, unit=unit)


def warn_of_mass(schedule: Schedule) -> None:
    """Warn if the damping is not for the own inertia of a torque-controlled arm."""
    words = "no known mass"
    if schedule.mass is not None:
        mass = schedule.mass if isinstance(schedule.mass, np.ndarray) else schedule.mass * np.eye(6)[np.newaxis]
        own = np.diagonal(mass[0])
        # A virtual mass is diagonal and the same all along, as no arm's own inertia is.
        if not np.allclose(mass, np.diag(own), rtol=checks.ROUNDING, atol=checks.ROUNDING * own.min()):
            return
        words = f"{own[0]:.3g} kg and {own[-1]:.3g} kg m^2"
    checks.warn(
        f"The damping of schedule is for {words}, but the arm moves with its own inertia, and may ring: give "
        "schedule.with_inertia(operational_inertia(model, joints, tool))."
    )


def check_start(schedule: Schedule, position: Floats, orientation: Floats) -> None:
    """Check that the schedule begins at the robot's pose, since it would jump otherwise."""
    away = float(np.linalg.norm(schedule.position[0] - position))
    turn = float(np.linalg.norm(rotations.between(orientation, poses(schedule)[1][0])))
    if not (away <= _NEAR and turn <= _TURNED):
        raise InvalidParameterError(
            f"the robot is {1e3 * away:.3g} mm and {turn:.3g} rad from the first pose of schedule, must be within "
            f"{1e3 * _NEAR:g} mm and {_TURNED:g} rad: bring it there first."
        )


@final
@dataclass(frozen=True, eq=False, repr=False)
class RobotRun:
    """Motion of a tool that followed a schedule, up to the end or a fault; what follows ``deviation`` if simulated.

    Attributes
    ----------
    time : (m,), s, within the schedule
    position, orientation : (m, 3) in m and (m, 4), quaternions w x y z
    deviation : (m, 6), m and rad
        Translation from the schedule, and the rotation vector from the desired to the true orientation.
    twist : (m, 6), m/s and rad/s
    wrench : (m, 6), N and Nm
        External wrench at the tool.
    joints, torque : (m, n), rad and Nm
        Joint angles and commanded torques.
    mass : (m, 6, 6), kg, kg m and kg m^2
        Inertia at the tool at the true joint angles.
    saturated : (m,) of bool, whether a motor gives less than the commanded torque
    """

    time: Floats
    position: Floats
    orientation: Floats
    deviation: Floats
    twist: Any = None
    wrench: Any = None
    joints: Any = None
    torque: Any = None
    mass: Any = None
    saturated: Any = None

    def __repr__(self) -> str:
        parts = np.split(self.deviation, 2, axis=1)
        farthest, widest = (np.linalg.norm(part, axis=1).max(initial=0.0) for part in parts)
        end = self.time.max(initial=0.0)
        return f"RobotRun(n={len(self.time)}, to {end:.6g} s, deviation up to {farthest:.3g} m, {widest:.3g} rad)"


def recorded(schedule: Schedule, rows: list[tuple[float, Floats, Floats]]) -> RobotRun:
    """Run of a robot from rows of time within the schedule, position and orientation."""
    table = np.reshape([np.hstack(row) for row in rows], (-1, 8))
    time, position, orientation = table[:, 0], table[:, 1:4], table[:, 4:]
    ends = schedule.time[[0, -1]]
    grid = np.union1d(np.clip(time, *ends), ends)  # two or more, however early the robot stopped
    desired, at = poses(schedule.resample(times=grid)), np.searchsorted(grid, np.clip(time, *ends))
    turn = rotations.between(desired[1][at], orientation)
    return RobotRun(time, position, orientation, np.hstack([position - desired[0][at], turn]))


@contextmanager
def stopping(stop: Callable[[], Any], on_fault: Callable[[RobotStoppedError], Any] | None) -> Iterator[None]:
    """Stop a robot at the end and at any fault; then call ``on_fault``, or raise if it is None."""
    cause: BaseException | None = None
    try:
        yield
    except BaseException as error:
        cause = error
    try:
        stop()
    except Exception as error:  # the robot's own words of why it had stopped
        cause = error if cause is None or isinstance(cause, Exception) else cause
    if cause is None:
        return
    if not isinstance(cause, Exception):  # the user's own stop, by the keyboard
        raise cause
    fault = cause if isinstance(cause, RobotStoppedError) else RobotStoppedError(f"{type(cause).__name__}: {cause}")
    if on_fault is None:
        raise fault from (None if fault is cause else cause)
    on_fault(fault)
