"""The schedule of the real-time controller: in rows of equal time, ready for a tick."""

import math
import struct
from typing import Any, final

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.places import Vector
from torch_pbd.control.realtime.steps import (
    Advance,
    Scale,
    Solve,
    advance_apart,
    advance_plane,
    advance_with,
    along_modes,
    coupled,
)
from torch_pbd.control.schedule import Schedule
from torch_pbd.control.schedule.rows import Between, count_rows, row_times

Blocks = tuple[slice, ...]

_LIGHTEST = 1e-50  # kg: products of gains with masses from this one to its inverse are numbers
_SINGULAR = 1e-12  # of damping relative to its largest entry, units of lengths and angles apart
_MAX_ROWS = 4_000_000  # an hour at 1 kHz, which takes 670 MB for d = 2


def virtual_mass(schedule: Schedule, given: Any) -> float | Floats:
    """Virtual mass, that of the schedule if None is given; a warning where it is another.

    A number in kg, or an array (d, d), or (n, d, d) where rows differ.
    """
    own, d = schedule.mass, schedule.n_outputs
    if isinstance(own, np.ndarray) and (own == own[0]).all():
        own = own[0]
    mass: Any = (1.0 if own is None else own) if given is None else given
    if np.ndim(mass) == 0:
        value: float | Floats = checks.number(mass, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg")
    elif given is None:
        value = mass
    else:
        value = checks.array(mass, "mass", (d, d))
        checks.semidefinite(value, "mass", definite=True)
    if own is not None:
        given_matrix, own_matrix = (each * np.eye(d) if np.ndim(each) == 0 else each for each in (value, own))
        if not np.all(given_matrix == own_matrix):
            of = f"mass={own:g} kg" if isinstance(own, float) else f"the {d} x {d} inertia of the schedule"
            checks.warn(f"mass is {mass}, but damping_ratio was met for {of}: give both the same.")
    return value


@final
class ScheduleTable:
    """A schedule in rows of equal time, the last one at ``end`` s, with no velocity.

    A row has the desired place, of ``n_place`` floats, and its velocity, of ``n_axes``; then what `advance_plane`,
    `along_modes` or `coupled` take. Its gains are per kg of a mass that is the same in all directions; of any other,
    ``mass`` (n, d, d) is that of the rows. ``stiffness`` and ``damping`` (n, d, d) are in N/m and N s/m, ``velocity``
    (n, d) and ``acceleration`` (n - 1, d) of the desired motion those before the last row was stopped. ``mobility`` has
    the largest norm of each block of D^-1: of the velocities of positions and rotations under steady forces and
    torques where damping alone acts. Rows of a ``steady`` table limit their springs by the largest stiffness of all.
    """

    mobility: Floats

    def __init__(
        self, schedule: Schedule, mass: float | Floats, rate: float, pull_limits: Vector, *, steady: bool = False
    ) -> None:
        duration = schedule.duration
        if count_rows(duration, rate) > _MAX_ROWS:
            must = f"at most {_MAX_ROWS / duration:g} for a schedule of {duration:g} s, a table of {_MAX_ROWS} rows"
            raise checks.refusal(rate, "rate", must, "lower it", unit="1/s")
        # A schedule shorter than a tick of the loop is begun and ended.
        grid = row_times(duration, rate) if count_rows(duration, rate) > 1 else np.array([0.0, duration])
        between = Between(schedule.time - schedule.time[0], grid)
        position, velocity, orientation = between.motion(schedule)
        place = position if orientation is None else np.concatenate([position, orientation], axis=1)
        self.stiffness, self.damping = between.linear(schedule.stiffness), between.linear(schedule.damping)
        self.rate, self.last, self.end = rate, len(grid) - 1, duration
        self.n_place, self.n_axes, self.blocks = place.shape[1], velocity.shape[1], schedule.blocks
        self.velocity, self.acceleration = velocity.copy(), np.diff(velocity, axis=0) / np.diff(grid)[:, np.newaxis]
        velocity[-1] = 0.0
        self.mass: Floats | None = None
        if isinstance(mass, np.ndarray):
            self.mass = between.linear(mass) if mass.ndim == 3 else np.broadcast_to(mass, self.stiffness.shape)
        solve, gains, along = _gains(self.stiffness, self.damping, mass if np.ndim(mass) < 3 else self.mass)
        unit = mass if isinstance(mass, float) else 1.0
        self.is_apart = len(self.blocks) == 2 and _are_apart(self.stiffness, *self.blocks)
        self.advance, springs = self._springs(solve, along, unit, pull_limits)
        for largest in springs[: (1 + self.is_apart) * steady]:
            largest[:] = largest.max()
        if along is not None and len(self.blocks) == 1 and self.mass is None:
            least = unit * float(along[1].min())
            self.mobility = np.full((1, 1), 1.0 / least if least > 0.0 else math.inf)
        else:
            self.mobility = _mobility(self.damping, self.blocks)
        # Rows are packed, for the garbage collector would hold up the loop to walk over a list of a million rows.
        parts = [part.reshape(len(grid), -1) for part in (place, velocity, *springs, *gains)]
        rows = np.concatenate(parts, axis=1)
        self.packed, self.layout = rows.tobytes(), struct.Struct(f"{rows.shape[1]}d")

    def row(self, index: int) -> Vector:
        """Row of the table, unpacked."""
        return self.layout.unpack_from(self.packed, index * self.layout.size)

    def scaled(self, stiffness: Floats, scale: Scale) -> Floats:
        """Stiffness (d, d) as scaled in a tick."""
        scales = scale if isinstance(scale, tuple) else (scale,) * len(self.blocks)
        sizes = [block.stop - block.start for block in self.blocks]
        return np.repeat(scales, sizes)[:, np.newaxis] * stiffness

    def forced(self, acceleration: Vector, index: int) -> Vector:
        """Push, as ticks take it, that causes an acceleration: a force, or that per kg."""
        return acceleration if self.mass is None else tuple((self.mass[index] @ acceleration).tolist())

    def accelerated(self, push: Vector, index: int) -> Vector:
        """Acceleration that such a push causes."""
        return push if self.mass is None else tuple(np.linalg.solve(self.mass[index], push).tolist())

    def _springs(
        self, solve: Solve, along: list[Floats] | None, unit: float, pull_limits: Vector
    ) -> tuple[Advance, list[Floats]]:
        """Function that advances, and what it needs of each row to limit the spring."""
        d, n_place = self.n_axes, self.n_place
        if along is not None and self.mass is None and d == n_place:
            return advance_plane if d == 2 else advance_with(solve, n_place, d), [along[0].max(axis=1)]
        # |K e|^2 <= k_max e'K e in each block, with k_max that of the block, also where others are displaced, for
        # |B'K e|^2 <= |B'K B| e'K e for any B.
        stiffest = [np.linalg.eigvalsh(self.stiffness[:, block, block])[:, -1] for block in self.blocks]
        largest = [most / limit**2 for most, limit in zip(stiffest, pull_limits, strict=True)]
        whole = np.max(largest, axis=0) * (pull_limits[0] ** 2 / unit)
        if not self.is_apart:
            return advance_with(solve, n_place, d), [whole]
        springs = [self.stiffness[:, block, block] for block in self.blocks]
        return advance_apart(solve, self.blocks[0].stop, d), [*largest, *springs, whole]


def _are_apart(stiffness: Floats, first: slice, second: slice) -> bool:
    """True if no stiffness couples positions and rotations."""
    along = np.sqrt(np.abs(stiffness).max(axis=0).diagonal())
    coupling = np.abs(stiffness[:, first, second]).max(axis=0)
    return bool((coupling <= checks.ROUNDING * np.multiply.outer(along[first], along[second])).all())


def _gains(stiffness: Floats, damping: Floats, mass: Any) -> tuple[Solve, list[Floats], list[Floats] | None]:
    """Function for gains of these rows, its part of each row, and stiffness and damping (n, d) of shared modes."""
    is_matrix = isinstance(mass, np.ndarray)
    if is_matrix:
        # With M = L L' modes are P = L'^-1 Q, P' M = Q' L', where Q are the axes of L^-1 K L'^-1 and L^-1 D L'^-1.
        tells, shapes = np.linalg.cholesky(mass).mT, np.linalg.inv(np.linalg.cholesky(mass))
        scaled = [shapes @ gain @ shapes.mT for gain in (stiffness, damping)]
    else:
        scaled = [stiffness / mass, damping / mass]
    largest = [np.maximum(np.abs(gain).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None] for gain in scaled]
    # Axes of the sum are those of both, also where equal values of one leave its own undetermined. A weight other than
    # 1 tells apart two axes of which one is as stiff as the other is damped.
    axes = np.linalg.eigh(scaled[0] / largest[0] + 0.6 * scaled[1] / largest[1]).eigenvectors
    turned = [axes.mT @ gain @ axes for gain in scaled]
    off = 1.0 - np.eye(stiffness.shape[1])
    if all((np.abs(gain * off) <= checks.ROUNDING * scale).all() for gain, scale in zip(turned, largest, strict=True)):
        along = [np.maximum(gain.diagonal(axis1=1, axis2=2), 0.0) for gain in turned]
        maps = [axes.mT @ tells, axes.mT @ shapes] if is_matrix else [axes.mT]
        return along_modes, [along[0], 0.5 * along[1], *maps], along
    if is_matrix:
        return coupled, [stiffness, damping, np.broadcast_to(np.linalg.inv(mass), stiffness.shape)], None
    return coupled, scaled, None


def _mobility(damping: Floats, blocks: Blocks) -> Floats:
    """Largest norm, over the rows, of each block of D^-1; not finite where it is singular."""
    scale = np.abs(damping).max(axis=(1, 2), keepdims=True)
    if np.linalg.eigvalsh(damping / np.where(scale > 0.0, scale, 1.0))[:, 0].min() <= _SINGULAR:
        return np.full((len(blocks), len(blocks)), math.inf)
    inverse = np.linalg.inv(damping)
    return np.array([[np.linalg.norm(inverse[:, b, c], 2, axis=(1, 2)).max() for c in blocks] for b in blocks])
