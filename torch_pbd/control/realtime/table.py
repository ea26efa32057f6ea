"""Schedule of the real-time controller as a table of evenly spaced rows, prepared for ticks."""

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.steps import State, Vector, advance_plane, along_modes, coupled, deviation, moved
from torch_pbd.control.schedule import Schedule
from torch_pbd.control.schedule.rows import Between, count_rows, refuse_other_units, row_times, warn_of_another_mass

Scale = float | Vector
"""Scale of the stiffness: that of all, or those of positions and of rotations."""

_LIGHTEST = 1e-50  # kg: float64 holds products of gains with masses from this one to its inverse
_SINGULAR = 1e-12  # damping that counts as singular, relative to its largest entry in the same units
_MAX_ROWS = 4_000_000  # an hour at 1 kHz, which takes 670 MB for d = 2


@final
class ScheduleTable:
    """Schedule in evenly spaced rows, the last one at ``end`` s with zero velocity.

    A row has the desired place, of ``n_place`` floats, and its velocity, at ``twist``; the largest stiffness of each of
    the ``springs`` over its squared limit, that of all rows if ``steady``; and what `advance` takes besides where modes
    are shared. ``velocity`` (n, d) and ``acceleration`` (n - 1, d) of the desired motion are those before the last row
    was stopped. ``mobility`` has the largest norm of each block of D^-1: of the velocities of positions and rotations
    under steady forces and torques where damping alone acts.
    """

    mobility: Floats

    def __init__(
        self, schedule: Schedule, mass: Any, rate: float, pull_limits: Vector, *, steady: bool = False
    ) -> None:
        refuse_other_units(schedule)
        if mass is not None:
            schedule, own = replace(schedule, mass=mass), schedule
            warn_of_another_mass(own, np.asarray(schedule.mass), "mass is another")
        mass = 1.0 if schedule.mass is None else schedule.mass
        duration = schedule.duration
        if count_rows(duration, rate) > _MAX_ROWS:
            must = f"at most {_MAX_ROWS / duration:g} for a schedule of {duration:g} s, a table of {_MAX_ROWS} rows"
            raise checks.refusal(rate, "rate", must, "lower it", unit="1/s")
        grid = row_times(duration, rate)
        between = Between(schedule.time - schedule.time[0], grid)
        position, velocity, orientation = between.motion(schedule)
        place = position if orientation is None else np.concatenate([position, orientation], axis=1)
        self.stiffness, self.damping = between.linear(schedule.stiffness), between.linear(schedule.damping)
        self.rate, self.last, self.end = rate, len(grid) - 1, duration
        self.n_place, self.n_axes, self.blocks = place.shape[1], velocity.shape[1], schedule.blocks
        self.twist = slice(self.n_place, self.n_place + self.n_axes)
        self.velocity, self.acceleration = velocity.copy(), np.diff(velocity, axis=0) / np.diff(grid)[:, np.newaxis]
        velocity[-1] = 0.0
        one = mass * np.eye(self.n_axes) if isinstance(mass, float) else mass
        self.one_mass = mass if isinstance(mass, float) else None
        checks.number(self.one_mass, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg", optional=True)
        masses = between.linear(one) if one.ndim == 3 else one[np.newaxis]
        self.mass = np.broadcast_to(masses, self.stiffness.shape)
        modes = _shared_modes(self.stiffness, self.damping, masses, self.one_mass)
        springs = self._springs(modes, pull_limits, steady)
        # Rows are packed, for the garbage collector would hold up the loop to walk over a list of a million rows.
        rows = np.concatenate([part.reshape(len(grid), -1) for part in (place, velocity, *springs)], axis=1)
        self.packed, self.layout = rows.tobytes(), struct.Struct(f"{rows.shape[1]}d")

    def _springs(self, modes: Sequence[Floats] | None, pull_limits: Vector, steady: bool) -> list[Floats]:
        """Columns of each row that a tick needs besides the motion."""
        blocks, mass = self.blocks, self.one_mass
        is_apart = len(blocks) == 2 and _are_apart(self.stiffness, *blocks)
        self.springs, self._are_shared = blocks if is_apart else (slice(0, self.n_axes),), modes is not None
        self._is_plane = modes is not None and mass is not None and self.n_place == self.n_axes == 2
        # |K e|^2 <= k_max e'K e in each block, with k_max that of the block, also where others are displaced, for
        # |B'K e|^2 <= |B'K B| e'K e for any B.
        if modes is not None and mass is not None and len(blocks) == 1:
            stiffest, least = [mass * modes[0].max(axis=1)], 2.0 * mass * float(modes[1].min())
            self.mobility = np.full((1, 1), 1.0 / least if least > 0.0 else math.inf)
        else:
            stiffest = [np.linalg.eigvalsh(self.stiffness[:, block, block])[:, -1] for block in blocks]
            self.mobility = _mobility(self.damping, blocks)
        tops = [most / limit**2 for most, limit in zip(stiffest, pull_limits, strict=True)]
        tops = tops if is_apart else [np.max(tops, axis=0)]
        tops = [np.full_like(top, top.max()) for top in tops] if steady else tops
        if modes is None:
            return tops
        if self._is_plane and mass is not None:  # along axes, with all per kg
            return [*tops, *modes[:2], modes[2][:, 0] / math.sqrt(mass), np.full(len(tops[0]), mass)]
        # Both of two springs are within their limits where the whole is within the tighter one.
        return [*tops, np.max(tops, axis=0), *modes]

    def row(self, index: int) -> Vector:
        """Row of the table, unpacked."""
        return self.layout.unpack_from(self.packed, index * self.layout.size)

    def advance(
        self, row: Vector, index: int, push: Vector, state: State, step: float, gains: Sequence[Floats] | None = None
    ) -> tuple[State, Scale]:
        """Place and velocity after ``step`` s, and the scale of the stiffness, by the row's gains or the given ones.

        Poses turn as about a fixed axis of the world, ``R <- Exp(dr) R``. The deviation is then told anew from where
        both are, so that its transport by the desired rotation, w_d x e, comes out by itself.
        """
        if self._is_plane and gains is None:
            return advance_plane(row, push, state, step)
        place, velocity = state
        motion, off = (row[self.twist], velocity), deviation(place, row[: self.n_place], self.n_axes)
        if gains is None and self._are_shared:
            by_modes = row[self.twist.stop + len(self.springs) :]
            move, faster, scale = along_modes(by_modes, push, off, motion, step)
            if scale == 1.0 or len(self.springs) == 1:
                return (moved(place, move), faster), scale
        # Where one of two springs is limited, modes are no longer shared: twisted beyond its torque, a tool keeps its
        # stiffness along the way.
        stiffness, damping = (self.stiffness[index], self.damping[index]) if gains is None else gains
        scales = self.scales(row, stiffness, np.array(off))
        stiffness = self.along_axes(scales)[:, np.newaxis] * stiffness
        move, velocity = coupled(stiffness, damping, self.one_mass or self.mass[index], push, off, motion, step)
        return (moved(place, move), velocity), scales[0] if scales[0] == scales[-1] else scales

    def scales(self, row: Vector, stiffness: Floats, off: Floats) -> Vector:
        """Scale of each spring of a stiffness (d, d) at a deviation, by its limit."""
        springs = zip(self.springs, row[self.twist.stop :], strict=False)
        pulls = [top * float(off[b] @ stiffness[b, b] @ off[b]) for b, top in springs]
        return tuple([1.0 / math.sqrt(max(pull, 1.0)) for pull in pulls])

    def along_axes(self, scales: Sequence[float]) -> Floats:
        """Scale (d,) of each axis, from that of each spring."""
        return np.repeat(scales, [spring.stop - spring.start for spring in self.springs])

    def forced(self, acceleration: Vector, index: int) -> Vector:
        """Force that causes an acceleration."""
        if self.one_mass is not None:
            return tuple([self.one_mass * part for part in acceleration])
        return tuple((self.mass[index] @ acceleration).tolist())

    def accelerated(self, force: Vector, index: int) -> Vector:
        """Acceleration that a force causes."""
        if self.one_mass is not None:
            return tuple([part / self.one_mass for part in force])
        return tuple(np.linalg.solve(self.mass[index], force).tolist())


def _are_apart(stiffness: Floats, first: slice, second: slice) -> bool:
    """Whether no row's stiffness couples positions and rotations."""
    along = np.sqrt(np.abs(stiffness).max(axis=0).diagonal())
    coupling = np.abs(stiffness[:, first, second]).max(axis=0)
    return bool((coupling <= checks.ROUNDING * np.multiply.outer(along[first], along[second])).all())


def _shared_modes(
    stiffness: Floats, damping: Floats, mass: Floats, one_mass: float | None
) -> tuple[Floats, ...] | None:
    """Modes of `along_modes` (n, d), (n, d), (n, d, d), (n, d, d), if stiffness and damping share them in all rows.

    With M = L L' they are P = L'^-1 Q, P' M = Q' L', where Q are the axes of L^-1 K L'^-1 and L^-1 D L'^-1.
    """
    factor = np.linalg.cholesky(mass)
    inverse = np.linalg.inv(factor)
    # Near critical damping a tick has fewer digits than gains over mass: one mass is not taken out by its root.
    scaled = [inverse @ gain @ inverse.mT if one_mass is None else gain / one_mass for gain in (stiffness, damping)]
    largest = [np.maximum(np.abs(gain).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None] for gain in scaled]
    # Axes of the sum are those of both, also where equal values of one leave its own undetermined. A weight other than
    # 1 tells apart two axes of which one is as stiff as the other is damped.
    axes = np.linalg.eigh(scaled[0] / largest[0] + 0.6 * scaled[1] / largest[1]).eigenvectors
    turned = [axes.mT @ gain @ axes for gain in scaled]
    off = 1.0 - np.eye(stiffness.shape[1])
    if any((np.abs(gain * off) > checks.ROUNDING * scale).any() for gain, scale in zip(turned, largest, strict=True)):
        return None
    k, d = (np.maximum(gain.diagonal(axis1=1, axis2=2), 0.0) for gain in turned)
    return k, 0.5 * d, axes.mT @ factor.mT, axes.mT @ inverse


def _mobility(damping: Floats, blocks: Sequence[slice]) -> Floats:
    """Largest norm, over the rows, of each block of D^-1; not finite where it is singular."""
    scale = np.abs(damping).max(axis=(1, 2), keepdims=True)
    if not checks.eigenvalues_above(damping / np.where(scale > 0.0, scale, 1.0), _SINGULAR):
        return np.full((len(blocks), len(blocks)), math.inf)
    inverse = np.linalg.inv(damping)
    parts = [[inverse[:, b, c] for c in blocks] for b in blocks]
    # Eigenvalues take a tenth of the time of singular values.
    return np.array([[math.sqrt(np.linalg.eigvalsh(part.mT @ part).max()) for part in row] for row in parts])
