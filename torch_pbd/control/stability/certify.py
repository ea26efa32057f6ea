"""Guarantees of a stiffness schedule, each by its name, and what it may touch."""

import math
from typing import Any

import torch
from torch import Tensor

from torch_pbd import checks, rotations
from torch_pbd.control.damping import required_damping_ratio
from torch_pbd.control.matrices import as_mass, mass_rows
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.sensor import PositionLoop
from torch_pbd.control.stability.common_function import common_function
from torch_pbd.control.stability.dynamics import ErrorDynamics
from torch_pbd.control.stability.environment import stiffest_environment
from torch_pbd.control.stability.gain import largest_gain
from torch_pbd.control.stability.lyapunov import Knots, held_growth
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.linalg import least_eigenvalue


def certify(
    schedule: Schedule | Any,
    *,
    mass: Any = None,
    speed: float = 1.0,
    position_loop: PositionLoop | Any = None,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> StabilityReport:
    """Check the stability of a schedule.

    Parameters
    ----------
    schedule : Schedule
        Whose times, gains and, for poses, angular velocities are checked.
    mass : float, array_like of shape (d, d) or (n, d, d), or callable, default=None
        Virtual mass of the admittance, or inertia of the arm at each row, in kg, for poses also kg m and kg m^2; or a
        function of time (n,), in s, that returns it. None is the schedule's own, or 1 kg.
    speed : float, default=1.0
        Replay speed: 2 is twice as fast.
    position_loop : PositionLoop, default=None
        For the stiffest environment; None is 20 Hz behind one tick.
    force_cutoff : float, default=500.0
        Of the force sensor's low-pass, Hz; None is none.
    dt : float, default=0.001
        Tick of the controller, s.

    Raises
    ------
    ValueError
        If the mass or speed is not positive, or a stiffness is not positive definite.

    References
    ----------
    K. Kronander, A. Billard, "Stability considerations for variable impedance control", IEEE Transactions on
    Robotics 32, 2016.
    """
    checks.number(speed, "speed", above=0.0)
    checks.number(dt, "dt", above=0.0, unit="s")
    checks.number(force_cutoff, "force_cutoff", above=0.0, unit="Hz", optional=True)
    checks.instance(position_loop, "position_loop", PositionLoop, optional=True)
    checks.instance(schedule, "schedule", Schedule)
    # An axis that is free never returns: nothing is to be certified of it.
    checks.semidefinite(schedule.stiffness, "stiffness", definite=True)
    time, stiffness, damping = map(torch.tensor, (schedule.time, schedule.stiffness, schedule.damping))
    given = schedule.mass if mass is None else mass(schedule.time) if callable(mass) else mass
    inertia = mass_rows(as_mass(1.0 if given is None else given), stiffness).detach()
    inertia = inertia if inertia.ndim == 3 else inertia[None]  # one for all rows
    dynamics = ErrorDynamics(time / speed, stiffness, damping, inertia, _transport(schedule, speed))
    knots, maps = Knots(dynamics), dynamics.tick_maps()
    alpha, margin, worst = knots.certificate()
    rate, fastest = common_function(dynamics)
    smallest, ratio = _ratios(dynamics)
    # The rule is of one function that no axis is special to: of one inertia, and of outputs of one unit.
    ratio = ratio if len(inertia) == 1 and schedule.orientation is None else math.nan
    loop = PositionLoop() if position_loop is None else position_loop
    pressed = [math.nan] * 2
    if len(inertia) == 1:  # an inertia that varies is an arm's own: there is no position loop
        for i, block in enumerate((slice(None), block, block) for block in schedule.blocks):
            pressed[i] = stiffest_environment(
                stiffness[block], damping[block], inertia[block][0], loop, force_cutoff, dt
            )
    return StabilityReport(
        damping_ratio=smallest,
        stiffness_ratio=ratio,
        required_damping_ratio=math.nan if math.isnan(ratio) else required_damping_ratio(ratio),
        stable_at_any_schedule=not math.isnan(rate),
        any_schedule_rate=rate,
        any_schedule_speed=speed * fastest,
        alpha=alpha,
        margin=margin,
        margin_time=float(schedule.time[worst]),
        held_growth=held_growth(dynamics, maps, alpha) if margin >= 0.0 else math.nan,
        max_speed=speed * knots.max_speed(),
        gain=largest_gain(maps),
        environment_stiffness=pressed[0],
        environment_rotation=pressed[1],
        speed=float(speed),
        mass=_as_given(inertia),
        inertia=tuple(_range(inertia[:, block, block]) for block in schedule.blocks),
        units=tuple("Nm/rad" if i or schedule.units == "rad" else "N/m" for i in range(len(schedule.blocks))),
    )


def _as_given(inertia: Tensor) -> float | tuple[tuple[float, ...], ...] | None:
    """One number, one matrix, or None where the rows differ."""
    if len(inertia) > 1:
        return None
    number = float(inertia[0, 0, 0])
    is_number = torch.equal(inertia[0], number * torch.eye(inertia.shape[-1]).to(inertia))
    return number if is_number else tuple(map(tuple, inertia[0].tolist()))


def _range(matrices: Tensor) -> tuple[float, float]:
    eigenvalues = torch.linalg.eigvalsh(matrices)
    return float(eigenvalues.min()), float(eigenvalues.max())


def _transport(schedule: Schedule, speed: float) -> Tensor | None:
    """What carries the deviations of poses along, (n, d, d), if they turn."""
    if schedule.orientation is None or not schedule.velocity[:, -3:].any():
        return None
    carried = torch.zeros(schedule.stiffness.shape, dtype=torch.float64)
    carried[:, -3:, -3:] = torch.tensor(speed * rotations.cross_matrix(schedule.velocity[:, -3:]))
    return carried


def _ratios(dynamics: ErrorDynamics) -> tuple[float, float]:
    """Smallest damping ratio, and largest over smallest stiffness per mass, each row in its own."""
    squared, _, damping = dynamics.modes
    root = squared.pow(-0.25)
    if damping.ndim == 2:
        least = float((root * damping * root).min())
    else:
        identity = torch.eye(squared.shape[-1]).to(squared)
        relative = root[:, :, None] * damping * root[:, None, :]
        least = least_eigenvalue(lambda rows, q, p: q * relative[rows] + p * identity, len(relative))[0]
    return least / 2.0, float(squared.max() / squared.min())
