"""Filters of the stiffness in the real-time loop: those of the simulation, on NumPy's arrays of one robot."""

import math
from copy import copy
from typing import final

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.filters import ActiveFilter, RateLimit, StiffnessFilter
from torch_pbd.control.realtime.steps import State, Vector, deviation, expm1
from torch_pbd.control.realtime.table import Scale, ScheduleTable
from torch_pbd.exceptions import InvalidParameterError


@final
class FilteredGains:
    """Stiffness and damping in effect, (d, d), and the ticks that they make: those of the table if all is granted.

    The springs of a table that is ``steady`` are limited by the largest stiffness of all rows: their force is that of
    one potential that is concave in e'K e, also where K changes. A rise of e'K e then puts at most ``scale / 2`` times
    itself into it, with the scale before the rise, and a fall takes at least as much out.
    """

    gains: tuple[Floats, Floats]
    _row: Vector

    def __init__(self, wanted: StiffnessFilter, table: ScheduleTable) -> None:
        checks.instance(wanted, "stiffness_filter", StiffnessFilter)
        mass = table.mass
        if not np.ptp(mass, axis=0).any():
            mass = mass[0]
        # In the simulation a run stops where the damping does not pay for what these add; a robot must not, half way.
        if isinstance(wanted, RateLimit) and (mass.ndim == 3 or len(table.blocks) == 2):
            raise InvalidParameterError(
                "stiffness_filter is a RateLimit, but the schedule has poses, or a mass that varies: it cannot know "
                "before the loop whether the damping pays for what turns or grows. Take EnergyTank()."
            )
        self._table, self._start = table, table.n_place + table.n_axes
        self._fresh = wanted.start(table.stiffness, table.damping, mass, _tick_change)

    def begin(self, index: int) -> None:
        """Forget all, at a row of the table: the next tick is given what it asks for."""
        self.active: ActiveFilter = copy(self._fresh)
        self.gains = self._table.stiffness[index], self._table.damping[index]

    def advance(self, row: Vector, index: int, push: Vector, here: State, step: float) -> tuple[State, Scale]:
        """Place and velocity after a tick of ``step`` s along a row of the table, and the scale of the stiffness."""
        table, active, scale = self._table, self.active, np.ones(self._table.n_axes)
        off = np.array(deviation(here[0], row[: table.n_place], table.n_axes))
        if active.gains is not None:
            # What is held on to turns with the desired orientation, as the tool sees it.
            turn: Floats = np.array(deviation(row[: table.n_place], self._row[: table.n_place], table.n_axes)[-3:])
            if table.n_place > table.n_axes and turn.any():
                active.carry(rotations.matrix(rotations.exp(turn)))
            for spring, part in zip(table.springs, table.scales(row, active.gains[0], off), strict=True):
                scale[spring] = part
        active.select(table.stiffness[index], table.damping[index], table.mass[index], step, off, scale)
        self._row, self.gains = row, active.gains[:2]
        return table.advance(row, index, push, here, step, self.gains if active.gains[2] < 1.0 else None)

    def settle(self, row: Vector, push: Vector, before: State, after: State) -> None:
        """Take note of the tick: place and velocity at its start and end, and the push held in it."""
        n_place, d = self._table.n_place, self._table.n_axes
        force = push + self.gains[1] @ row[n_place : self._start]
        start, end = ((np.array(deviation(place, row[:n_place], d)), np.array(v)) for place, v in (before, after))
        self.active.settle(start, end, force, self._energy)

    def _energy(self, stiffness: Floats, off: Floats) -> float:
        """Energy of the limited springs in J."""
        energy = 0.0
        for spring, top in zip(self._table.springs, self._row[self._start :], strict=False):
            stretch = float(off[spring] @ stiffness[spring, spring] @ off[spring])
            energy += 0.5 * stretch if top * stretch <= 1.0 else math.sqrt(stretch / top) - 0.5 / top
        return energy


def _tick_change(stiffness: Floats, damping: Floats, mass: Floats, step: float) -> Floats:
    """What deviation and velocity change by over a tick: a matrix (2 d, 3 d) on them and on the force."""
    d = len(mass)
    rate = np.zeros((3 * d, 3 * d))
    rate[:d, d : 2 * d] = np.eye(d)
    rate[d : 2 * d] = np.linalg.solve(mass, np.concatenate([-stiffness, -damping, np.eye(d)], axis=1))
    return expm1(step * rate)[: 2 * d]
