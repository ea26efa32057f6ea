"""The schedule of the real-time controller: checked, in rows of equal time, ready for a tick."""

import math
import struct
from collections.abc import Callable
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.control.realtime.checks import LARGEST
from torch_pbd.control.realtime.steps import Floats, Vector, advance_coupled, advance_modal, advance_plane
from torch_pbd.control.schedule.rows import Between

Advance = Callable[[Vector, Vector, Vector, Vector, float, float], tuple[Vector, Vector, float]]

_ROUNDING = 1e-9  # relative: what is smaller counts as rounding of whoever made the schedule
_TICK_ROUNDING = 1e-3  # of a tick: 10 s at 1 kHz are 10001 rows, as those of a schedule are counted
_READ = ("time", "position", "velocity", "stiffness", "damping")
_MAX_ROWS = 4_000_000  # an hour at 1 kHz


class ScheduleLike(Protocol):
    """What is read of a :class:`~torch_pbd.control.Schedule`, which would bring torch along."""

    @property
    def time(self) -> Floats: ...  # noqa: D102
    @property
    def position(self) -> Floats: ...  # noqa: D102
    @property
    def velocity(self) -> Floats: ...  # noqa: D102
    @property
    def stiffness(self) -> Floats: ...  # noqa: D102
    @property
    def damping(self) -> Floats: ...  # noqa: D102
    @property
    def stiffness_limits(self) -> tuple[float, float] | None: ...  # noqa: D102


class ScheduleTable(NamedTuple):
    """The schedule in rows of equal time, ready for use, all per kg.

    A row has position, velocity and the largest stiffness; then for `advance_modal` the stiffness of each axis, half
    its damping, and the axes; for `advance_coupled` the two matrices. They are packed, for the garbage collector
    would hold up the loop to walk over a list of a million rows. The last, at ``end`` s, has no velocity; ``speeds``
    (n,) and the largest ``acceleration`` of the desired motion are those before that.
    """

    packed: bytes
    layout: struct.Struct
    last: int
    rate: float
    advance: Advance
    stiffness: Floats
    damping: Floats
    end: float
    speeds: Floats
    acceleration: float

    @classmethod
    def of(cls, schedule: ScheduleLike, mass: float, rate: float) -> Self:
        """Check the schedule and sample it."""
        time, *values = _checked(schedule)
        n_rows = math.ceil((time[-1] - time[0]) * rate - _TICK_ROUNDING) + 1
        if n_rows > _MAX_ROWS:
            raise ValueError(f"rate={rate} makes {n_rows} rows of the schedule, more than {_MAX_ROWS}: lower it.")
        grid = np.append(np.arange(n_rows - 1) / rate, time[-1] - time[0])
        between = Between(time - time[0], grid)
        position, velocity = between.hermite(*values[:2])
        stiffness, damping = map(between.linear, values[2:])
        speeds = np.linalg.norm(velocity, axis=1)
        accelerations = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / np.diff(grid)
        motion = float(grid[-1]), speeds, float(accelerations.max(initial=0.0))
        velocity[-1] = 0.0
        advance, gains = _gains(stiffness / mass, damping / mass)
        rows = np.concatenate([part.reshape(n_rows, -1) for part in (position, velocity, *gains)], axis=1)
        layout = struct.Struct(f"{rows.shape[1]}d")
        return cls(rows.tobytes(), layout, n_rows - 1, rate, advance, stiffness, damping, *motion)

    @property
    def n_axes(self) -> int:
        """Number of axes d."""
        return self.stiffness.shape[1]

    def row(self, index: int) -> Vector:
        """One row, unpacked."""
        return self.layout.unpack_from(self.packed, index * self.layout.size)


def _gains(stiffness: Floats, damping: Floats) -> tuple[Advance, list[Floats]]:
    """How to advance, and the part of each row that it takes."""
    pair = (stiffness, damping)
    largest = [np.maximum(np.abs(gain).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None] for gain in pair]
    # Axes of the sum are those of both, also where equal values of one leave its own undetermined.
    axes = np.linalg.eigh(stiffness / largest[0] + 0.6 * damping / largest[1]).eigenvectors
    turned = [axes.mT @ gain @ axes for gain in pair]
    along = [np.maximum(gain.diagonal(axis1=1, axis2=2), 0.0) for gain in turned]
    off = 1.0 - np.eye(stiffness.shape[1])
    if all((np.abs(gain * off) <= _ROUNDING * scale).all() for gain, scale in zip(turned, largest, strict=True)):
        advance = advance_plane if stiffness.shape[1] == 2 else advance_modal
        return advance, [along[0].max(axis=1), along[0], 0.5 * along[1], axes.mT]
    return advance_coupled, [np.linalg.norm(stiffness, 2, axis=(1, 2)), *pair]


def _checked(schedule: ScheduleLike) -> list[Floats]:
    """Copies of time, position, velocity, stiffness and damping that a robot can follow."""
    missing = [name for name in (*_READ, "stiffness_limits") if not hasattr(schedule, name)]
    if missing:
        raise ValueError(f"schedule is a {type(schedule).__name__} without {', '.join(missing)}: give a Schedule.")
    position = checks.real_floats(schedule.position, "schedule.position")
    if position.ndim != 2 or not position.size:
        raise ValueError(f"schedule.position has shape {position.shape}: it must be (n, d), n and d at least 1.")
    n, d = position.shape
    shapes = {"time": (n,), "position": (n, d), "velocity": (n, d), "stiffness": (n, d, d), "damping": (n, d, d)}
    arrays = {name: np.array(checks.real_floats(getattr(schedule, name), f"schedule.{name}")) for name in shapes}
    for name, array in arrays.items():
        if not n * d or array.shape != shapes[name]:
            raise ValueError(
                f"schedule.{name} has shape {array.shape}: with (n, d) positions, n and d at least 1, "
                f"it must be {shapes[name]}."
            )
        _refuse(~(np.abs(array) <= LARGEST), array, name, f"it must be finite, and at most {LARGEST:g} in size.")
    _refuse(np.diff(arrays["time"], prepend=-np.inf) <= 0.0, arrays["time"], "time", "times must increase strictly.")
    least_stiffness = _symmetrized(arrays, "stiffness", schedule.stiffness_limits)
    least_damping = _symmetrized(arrays, "damping", None)
    free = (least_stiffness <= 0.0) & (least_damping <= 0.0)
    _refuse(
        free, arrays["stiffness"], "stiffness", "without stiffness an axis needs damping, for nothing else stops it."
    )
    return list(arrays.values())


def _symmetrized(arrays: dict[str, Floats], name: str, limits: tuple[float, float] | None) -> Floats:
    """Make the matrices symmetric to the bit; their least eigenvalues, 0 where that is rounding."""
    gain = arrays[name]
    scale = np.abs(gain).max(axis=(1, 2))
    _refuse(np.abs(gain - gain.mT).max(axis=(1, 2)) > _ROUNDING * scale, gain, name, "it must be symmetric.")
    arrays[name] = gain = 0.5 * (gain + gain.mT)
    values = np.linalg.eigvalsh(gain)
    _refuse(values[:, 0] < -_ROUNDING * scale, gain, name, "no eigenvalue may be negative.")
    if limits is not None:
        low, high = limits
        beyond = (values[:, 0] < low - _ROUNDING * high) | (values[:, -1] > high + _ROUNDING * high)
        _refuse(beyond, gain, name, f"its eigenvalues must be within stiffness_limits={limits}.")
    return np.where(values[:, 0] > _ROUNDING * scale, values[:, 0], 0.0)


def _refuse(bad: NDArray[np.bool_], values: Floats, name: str, requirement: str) -> None:
    rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
    if len(rows):
        raise ValueError(f"schedule.{name}[{rows[0]}] is {values[rows[0]].tolist()}: {requirement}")
