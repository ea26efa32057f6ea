"""The schedule of the real-time controller: in rows of equal time, ready for a tick."""

import struct
from collections.abc import Callable
from typing import final

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.steps import State, Vector, advance_coupled, advance_modal, advance_plane
from torch_pbd.control.schedule import Schedule
from torch_pbd.control.schedule.rows import Between, count_rows, row_times
from torch_pbd.exceptions import InvalidParameterError

Advance = Callable[[Vector, Vector, State, float, float], tuple[State, float]]

_LIGHTEST = 1e-50  # kg: products of gains with masses from this one to its inverse are numbers
_MAX_ROWS = 4_000_000  # an hour at 1 kHz, which takes 670 MB for d = 2


def virtual_mass(own: float | Floats | None, given: float | None) -> float:
    """Virtual mass in kg, that of the schedule if None is given; a warning where it is another."""
    if isinstance(own, np.ndarray):
        raise InvalidParameterError(
            "the schedule has a mass matrix, must have one virtual mass in kg: schedule.with_inertia(mass)."
        )
    mass = (own or 1.0) if given is None else given
    value = checks.number(mass, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg")
    if own is not None and value != own:
        checks.warn(f"mass is {mass}, but damping_ratio was met for mass={own:g} kg: give both the same.")
    return value


@final
class ScheduleTable:
    """A schedule in rows of equal time, the last one at ``end`` s, with no velocity.

    A row has position, velocity and the largest stiffness; then for `advance_modal` the stiffness of each axis, half
    its damping, and the axes; for `advance_coupled` the two matrices: all gains of rows per kg of virtual mass.
    ``stiffness`` and ``damping`` (n, d, d) are in N/m and N s/m, ``speeds`` (n,) and the largest ``acceleration`` of
    the desired motion those before the last row was stopped.
    """

    def __init__(self, schedule: Schedule, mass: float, rate: float) -> None:
        duration = schedule.duration
        if count_rows(duration, rate) > _MAX_ROWS:
            must = f"at most {_MAX_ROWS / duration:g} for a schedule of {duration:g} s, a table of {_MAX_ROWS} rows"
            raise checks.refusal(rate, "rate", must, "lower it", unit="1/s")
        # A schedule shorter than a tick of the loop is begun and ended.
        grid = row_times(duration, rate) if count_rows(duration, rate) > 1 else np.array([0.0, duration])
        between = Between(schedule.time - schedule.time[0], grid)
        position, velocity = between.hermite(schedule.position, schedule.velocity)
        self.stiffness, self.damping = between.linear(schedule.stiffness), between.linear(schedule.damping)
        self.rate, self.last, self.end, self.n_axes = rate, len(grid) - 1, duration, position.shape[1]
        self.speeds = np.linalg.norm(velocity, axis=1)
        accelerations = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / np.diff(grid)
        self.acceleration = float(accelerations.max())
        velocity[-1] = 0.0
        self.advance, least_damping, gains = _gains(self.stiffness / mass, self.damping / mass)
        self.least_damping = mass * least_damping
        # Rows are packed, for the garbage collector would hold up the loop to walk over a list of a million rows.
        rows = np.concatenate([part.reshape(len(grid), -1) for part in (position, velocity, *gains)], axis=1)
        self.packed, self.layout = rows.tobytes(), struct.Struct(f"{rows.shape[1]}d")

    def row(self, index: int) -> Vector:
        """One row, unpacked."""
        return self.layout.unpack_from(self.packed, index * self.layout.size)


def _gains(stiffness: Floats, damping: Floats) -> tuple[Advance, float, list[Floats]]:
    """Function that advances rows of these gains, their smallest damping, and the part of each row that it takes."""
    pair = (stiffness, damping)
    largest = [np.maximum(np.abs(gain).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None] for gain in pair]
    # Axes of the sum are those of both, also where equal values of one leave its own undetermined. A weight other than
    # 1 tells apart two axes of which one is as stiff as the other is damped.
    axes = np.linalg.eigh(stiffness / largest[0] + 0.6 * damping / largest[1]).eigenvectors
    turned = [axes.mT @ gain @ axes for gain in pair]
    along = [np.maximum(gain.diagonal(axis1=1, axis2=2), 0.0) for gain in turned]
    off = 1.0 - np.eye(stiffness.shape[1])
    if all((np.abs(gain * off) <= checks.ROUNDING * scale).all() for gain, scale in zip(turned, largest, strict=True)):
        advance = advance_plane if stiffness.shape[1] == 2 else advance_modal
        return advance, float(along[1].min()), [along[0].max(axis=1), along[0], 0.5 * along[1], axes.mT]
    least = float(np.linalg.eigvalsh(damping).min())
    return advance_coupled, least, [np.linalg.norm(stiffness, 2, axis=(1, 2)), *pair]
