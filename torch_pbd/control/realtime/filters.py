"""Filters of the stiffness in the real-time loop: those of the simulation in NumPy, one tick at a time."""

import math
from typing import Any, final

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.filters import MARGIN, EnergyTank, RateLimit, StiffnessFilter
from torch_pbd.control.realtime.places import Vector, deviation
from torch_pbd.control.realtime.steps import Scale, State, advance_apart, advance_with, coupled, expm1
from torch_pbd.control.realtime.table import ScheduleTable
from torch_pbd.exceptions import InvalidParameterError


@final
class FilteredGains:
    """Stiffness and damping in effect, (d, d), and the ticks that they make: those of the table if all is granted.

    The springs of a table that is ``steady`` are limited by the largest stiffness of all rows: their force is that of
    one potential that is concave in e'K e, also where K changes. A rise of e'K e then puts at most ``scale / 2`` times
    itself into it, with the scale before the rise, and a fall takes at least as much out.
    """

    stiffness: Floats
    damping: Floats

    def __init__(self, wanted: StiffnessFilter, table: ScheduleTable, unit: float, pull_limit: float) -> None:
        checks.instance(wanted, "stiffness_filter", StiffnessFilter)
        d, self._start = table.n_axes, table.n_place + table.n_axes
        self._table, self._unit, self._pull_limit = table, unit, pull_limit
        self._mass = np.broadcast_to(unit * np.eye(d), table.stiffness.shape) if table.mass is None else table.mass
        row = table.row(0)[self._start :]
        if table.is_apart:
            self._springs = tuple(zip(table.blocks, row, strict=False))
            self._partly = advance_apart(coupled, table.blocks[0].stop, d)
        else:
            self._springs = ((slice(0, d), row[0] / (unit * pull_limit * pull_limit)),)
            self._partly = advance_with(coupled, table.n_place, d)
        self._rule = _Tank(wanted) if isinstance(wanted, EnergyTank) else _rate_limit(wanted, table, self._mass)
        self.begin(0)

    @property
    def tank_energy(self) -> float | None:
        """Energy in the tank in J; None where there is none."""
        return self._rule.energy if isinstance(self._rule, _Tank) else None

    def begin(self, index: int) -> None:
        """Forget all: the next tick is given what it asks for."""
        self.share, self._is_new = 1.0, True
        self.stiffness, self.damping = self._table.stiffness[index], self._table.damping[index]
        self._rule.begin()

    def advance(self, row: Vector, index: int, push: Vector, here: State, step: float) -> tuple[State, Scale]:
        """Place and velocity after a tick of ``step`` s along a row of the table, and the scale of the stiffness."""
        table = self._table
        gains = table.stiffness[index], table.damping[index]
        off = np.array(deviation(here[0], row[: table.n_place], table.n_axes))
        if not self._is_new:
            last = self._held(row)
            scales = self._scales(last[0], off)
            share = self.share = self._rule.share(last, gains, off, scales)
            if share < 1.0:
                gains = last[0] + share * (gains[0] - last[0]), last[1] + share * (gains[1] - last[1])
            self._rule.pay(gains[0] - last[0], off, scales)
        self._row, self._index = row, index
        (self.stiffness, self.damping), self._is_new = gains, False
        self._rule.step = step
        if self.share == 1.0:
            return table.advance(row, push, here, step, self._pull_limit)
        tops, inverse = [top for _, top in self._springs], np.linalg.inv(self._mass[index])
        springs = [self.stiffness[block, block].ravel() for block in table.blocks] if table.is_apart else []
        parts = [*springs, np.zeros(1 if table.is_apart else 0), *[part.ravel() for part in (*gains, inverse)]]
        force = tuple([self._unit * part for part in push])
        return self._partly((*row[: self._start], *tops, *np.concatenate(parts).tolist()), force, here, step, 1.0)

    def settle(self, row: Vector, push: Vector, before: State, after: State) -> None:
        """Take note of the tick: place and velocity at its start and end, and the push held in it."""
        table, d = self._table, self._table.n_axes
        goal, velocity = row[: table.n_place], np.array(row[table.n_place : self._start])
        force = np.multiply(self._unit, push) + self.damping @ velocity
        states = [(np.array(deviation(place, goal, d)), np.array(speed)) for place, speed in (before, after)]
        energies = [self._potential(off) for off, _ in states]
        self._rule.settle(states, force, energies, self._mass[self._index])

    def _held(self, row: Vector) -> tuple[Floats, Floats]:
        """Gains of the last tick, taken along where the desired orientation has turned: as the tool sees them."""
        n_place, d = self._table.n_place, self._table.n_axes
        if n_place == d:
            return self.stiffness, self.damping
        turn = np.array(deviation(row[:n_place], self._row[:n_place], d)[-3:])
        if not turn.any():
            return self.stiffness, self.damping
        whole = np.eye(d)
        whole[-3:, -3:] = rotations.matrix(rotations.exp(turn))
        first, second = (whole @ gain @ whole.T for gain in (self.stiffness, self.damping))
        return 0.5 * (first + first.T), 0.5 * (second + second.T)

    def _scales(self, stiffness: Floats, off: Floats) -> Floats:
        """Scale (d,) of a stiffness at a deviation."""
        scales = np.ones(len(off))
        for block, top in self._springs:
            scales[block] = 1.0 / math.sqrt(max(1.0, top * _quadratic(stiffness[block, block], off[block])))
        return scales

    def _potential(self, off: Floats) -> float:
        """Energy of the limited springs in J."""
        energy = 0.0
        for block, top in self._springs:
            stretch = _quadratic(self.stiffness[block, block], off[block])
            energy += 0.5 * stretch if top * stretch <= 1.0 else math.sqrt(stretch / top) - 0.5 / top
        return energy


class _Tank:
    """See :class:`~torch_pbd.control.EnergyTank`."""

    step = 0.0

    def __init__(self, tank: EnergyTank) -> None:
        self._tank = tank

    def begin(self) -> None:
        self.energy = self._tank.energy

    def share(self, last: tuple[Floats, Floats], wanted: tuple[Floats, Floats], off: Floats, scales: Floats) -> float:
        asked = 0.5 * _quadratic(wanted[0] - last[0], off, scales)
        return (1.0 - MARGIN) * self.energy / asked if asked > self.energy else 1.0

    def pay(self, rise: Floats, off: Floats, scales: Floats) -> None:
        self._take(0.5 * _quadratic(rise, off, scales))

    def settle(self, states: list[tuple[Floats, Floats]], force: Floats, potentials: list[float], mass: Floats) -> None:
        (off, velocity), (later, faster) = states
        kinetic = 0.5 * (_quadratic(mass, velocity) - _quadratic(mass, faster))
        dissipated = potentials[0] - potentials[1] + kinetic + float(force @ (later - off))
        # What looks like negative dissipation is rounding, or a limit of the command: it is charged in full.
        self._take(-self._tank.efficiency * dissipated if dissipated > 0.0 else -dissipated)

    def _take(self, energy: float) -> None:
        self.energy = min(max(self.energy - energy, 0.0), self._tank.energy_max)


class _Rate:
    """See :class:`~torch_pbd.control.RateLimit`; the derivation is beside that of the simulation."""

    step = 0.0

    def __init__(self, alpha: float, mass: Floats) -> None:
        self._alpha, self._mass = alpha, mass

    def begin(self) -> None:
        self.step = 0.0

    def share(self, last: tuple[Floats, Floats], wanted: tuple[Floats, Floats], off: Floats, scales: Floats) -> float:
        (stiffness, damping), mass, alpha, step = last, self._mass, self._alpha, self.step
        d = len(mass)
        rise = wanted[0] - stiffness + alpha * (wanted[1] - damping)
        if not rise.any():
            return 1.0
        inverse, rate = np.linalg.inv(mass), np.zeros((3 * d, 3 * d))
        rate[:d, d : 2 * d] = np.eye(d)
        rate[d : 2 * d] = inverse @ np.concatenate([-stiffness, -damping, np.eye(d)], axis=1)
        start = np.eye(3 * d)
        moved = expm1(step * rate)[: 2 * d]
        pull = step * start[2 * d :] - mass @ moved[d:] - damping @ moved[:d]
        port = moved[:d] + alpha * np.linalg.solve(stiffness, pull)
        function = np.block([[stiffness + alpha * damping, alpha * mass], [alpha * mass, mass]])
        # Of E' P E - P for E = 1 + moved the P is left out, which has none of the digits that count in short ticks.
        given = np.pad(port, ((2 * d, 0), (0, 0))) - start[:, : 2 * d] @ function @ moved
        paid = given + given.T - moved.T @ function @ moved
        try:
            half = np.linalg.solve(np.linalg.cholesky(paid), (moved + start[: 2 * d])[:d].T)
        except np.linalg.LinAlgError:  # of a tick so short that rounding hides what it pays
            return 0.0
        needed = float(np.linalg.eigvalsh(half @ rise @ half.T)[-1])
        return (1.0 - MARGIN) / needed if needed > 1.0 else 1.0

    def pay(self, rise: Floats, off: Floats, scales: Floats) -> None:
        """Pay nothing: what a tick pays is told from its gains."""

    def settle(self, states: list[tuple[Floats, Floats]], force: Floats, potentials: list[float], mass: Floats) -> None:
        """Note nothing."""


def _rate_limit(wanted: Any, table: ScheduleTable, masses: Floats) -> _Rate:
    checks.instance(wanted, "stiffness_filter", RateLimit)
    mass = masses[0]
    # In the simulation a run stops where the damping does not pay for what these add; a robot must not, half way.
    if len(table.blocks) == 2 or np.ptp(masses, axis=0).any():
        raise InvalidParameterError(
            "stiffness_filter is a RateLimit, but the schedule has poses, or a mass that varies: it cannot know before "
            "the loop whether the damping pays for what turns or grows. Take EnergyTank()."
        )
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    over_mass, softest = (
        np.linalg.eigvalsh(each).min() for each in (inverse @ table.damping @ inverse.T, table.stiffness)
    )
    return _Rate(wanted.constant(float(over_mass), float(softest)), mass)


def _quadratic(matrix: Floats, vector: Floats, scales: Floats | None = None) -> float:
    return float((vector if scales is None else scales * vector) @ matrix @ vector)
