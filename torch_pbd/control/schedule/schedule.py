"""The schedule of a controller: position, velocity, stiffness and damping over time, and how sure the model was."""

import os
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule import rows
from torch_pbd.control.schedule.contents import LABELS, SHAPES, Limits, checked_fields
from torch_pbd.control.schedule.files import read_schedule, write_schedule
from torch_pbd.exceptions import InvalidParameterError

if TYPE_CHECKING:
    from torch_pbd.control.stability.report import StabilityReport


@final
@dataclass(frozen=True, eq=False, repr=False)
class Schedule:
    """Position, velocity, stiffness and damping over time, with the covariance they come from.

    Of positions alone, d = p; or of poses, d = p + 3: twists, wrenches and gains then have the positions first and
    rotations last, all in world axes. The stiffness acts on the deviation ``(x - x_d, Log(R R_d'))``, whose last three
    are a rotation vector in rad. Between its rows it is what `resample` says. It is immutable; its arrays are read-only
    float64 copies.

    Parameters
    ----------
    time : array_like of shape (n,)
        In s, strictly increasing, n >= 2.
    position : array_like of shape (n, p)
        Desired, in ``units``.
    velocity : array_like of shape (n, d)
        Desired, in ``units``/s; of rotations in rad/s.
    stiffness, damping : array_like of shape (n, d, d)
        In N/m and N s/m, and for rotations Nm/rad and Nm s/rad; symmetric and positive semidefinite. Where the
        stiffness is singular, the damping must be positive definite: nothing else would stop the robot.
    covariance : array_like of shape (n, d, d)
        Covariance of the demonstrations, at the desired pose; symmetric and positive semidefinite.
    type1 : array_like of shape (n,)
        How little the model knows: 0 (on data) to 1 (the prior alone).
    acceleration : array_like of shape (n, d), default=None
        Desired, in ``units``/s^2 and rad/s^2; None where it is not known.
    orientation : array_like of shape (n, 4), default=None
        Desired, as unit quaternions w x y z that turn the tool's vectors into the world's. Signs are made continuous.
    names : sequence of d str, default=None
        Names of the outputs.
    units, frame : str, default="m", None
        Unit of the position, name of the coordinate frame; None where it is not known.
    stiffness_limits : (low, high), default=None
        Least and largest stiffness, each a number for all axes, in N/m, or d numbers: ``diag(low) <= K <= diag(high)``.
    covariance_of : {"position", "forcing"}, default="position"
        Quantity that the covariance belongs to: a forcing is that of eq. (18).
    mass : float, or array_like of shape (d, d) or (n, d, d), default=None
        Inertia that the damping was computed for: the virtual mass of an admittance in kg, or that of an arm along the
        schedule in kg, kg m and kg m^2, symmetric and positive definite.
    provenance : mapping, default={}
        Whatever JSON can hold about where the schedule comes from.

    Raises
    ------
    InvalidParameterError
        If an argument is not as described; a ValueError that names the row.
    """

    time: Floats
    position: Floats
    velocity: Floats
    stiffness: Floats
    damping: Floats
    covariance: Floats
    type1: Floats
    _: KW_ONLY
    acceleration: Floats | None = None
    orientation: Floats | None = None
    names: tuple[str, ...] | None = None
    units: str | None = "m"
    frame: str | None = None
    stiffness_limits: Limits | None = None
    covariance_of: str = "position"
    mass: float | Floats | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in checked_fields(vars(self)).items():
            object.__setattr__(self, name, value)

    @property
    def n_outputs(self) -> int:
        """Number of outputs d: of positions, and three of an orientation."""
        return self.velocity.shape[1]

    @property
    def blocks(self) -> tuple[slice, ...]:
        """Outputs that share a unit: the positions, and the rotation if there is an orientation."""
        p, d = self.position.shape[1], self.n_outputs
        return (slice(0, p), slice(p, d)) if d > p else (slice(0, p),)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, in s."""
        return float(self.time[-1] - self.time[0])

    def __len__(self) -> int:
        return len(self.time)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Schedule):
            return NotImplemented
        mine, theirs = self._arrays(), other._arrays()
        same = self._labels() == other._labels() and mine.keys() == theirs.keys()
        return same and all(np.array_equal(array, theirs[name]) for name, array in mine.items())

    def __repr__(self) -> str:
        outputs = f"names={self.names}" if self.names else f"n_outputs={self.n_outputs}"
        parts = [f"n={len(self)}", outputs, f"time={self.time[0]:.6g}..{self.time[-1]:.6g} s"]
        angles = self.units == "rad"
        units = {
            "stiffness": ("Nm/rad" if angles else "N/m", "Nm/rad"),
            "mass": ("kg m^2" if angles else "kg", "kg m^2"),
        }
        for name, of_blocks in units.items():
            value, ranges = getattr(self, name), []
            for block, unit in zip(self.blocks if value is not None else (), of_blocks, strict=False):
                matrices = value * np.eye(self.n_outputs) if isinstance(value, float) else value
                eigenvalues = np.linalg.eigvalsh(matrices[..., block, block])
                low, high = (f"{value:.4g}" for value in (eigenvalues.min(), eigenvalues.max()))
                ranges.append(f"{low} {unit}" if low == high else f"{low}..{high} {unit}")
            parts += [f"{name}={' and '.join(ranges)}"] if ranges else []
        return f"Schedule({', '.join(parts)}, frame={self.frame!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies go through the constructor: NumPy forgets that an array is read-only when it is pickled or copied.
        return partial(Schedule, **self._labels() | self._arrays()), ()

    def resample(self, rate: float | None = None, *, times: ArrayLike | None = None) -> "Schedule":
        """Rows at other times, all within the schedule.

        Stiffness, damping, covariance, mass, acceleration and type1 are piecewise linear, so that matrices stay
        symmetric, positive semidefinite and within their limits. The position is the cubic of each interval through
        positions and velocities of its ends (Hermite), the velocity its derivative: damping acts on no motion that the
        position does not make. Orientations are such cubics of the rotation vector from the row before.

        Parameters
        ----------
        rate : float, default=None
            In Hz: rows every 1/rate from the first time on, and one at the end.
        times : array_like of shape (m,), default=None
            Strictly increasing, m >= 2, in s; either this or ``rate``. What the rows say in between is lost.

        Raises
        ------
        ValueError
            If not exactly one is given, ``rate`` leaves less than two rows, or a time is outside.
        """
        if (rate is None) == (times is None):
            raise InvalidParameterError(f"give either rate or times; got rate={rate!r} and times={times!r}.")
        first, last = self.time[0], self.time[-1]
        if rate is not None:
            grid = np.append(first + rows.tick_times(self.duration, rate, self.n_outputs)[:-1], last)
        else:
            grid = checks.array(times, "times", ("m",))
        checks.require((grid >= first) & (grid <= last), grid, "times", f"from {first!s} to {last!s} s", unit="s")
        between = rows.Between(self.time, grid)
        made: dict[str, Any] = {name: between.linear(array) for name, array in self._arrays().items()}
        motion = dict(zip(("position", "velocity", "orientation"), between.motion(self), strict=True))
        return replace(self, **made | motion | {"time": grid})

    def retime(self, speed: float, *, mass: Any = None) -> "Schedule":
        """Schedule that is ``speed`` times as fast: time / speed, velocity * speed, gains and masses as they are.

        Parameters
        ----------
        speed : float
            From 1e-9 to 1e9; the stiffness rises that much faster too.
        mass : float, array_like of shape (d, d) or (n, d, d), or callable, default=None
            As for :func:`~torch_pbd.control.certify`, to check the stability at the new speed. None: not checked.

        Raises
        ------
        ValueError
            If ``speed`` is not within these, or none of the guarantees of the report holds at it with ``mass``.
        """
        # Beyond these, a year for a second, speeds are mistakes; within, times and velocities keep their digits.
        speed = checks.number(speed, "speed", least=1e-9, most=1e9)
        report = None if mass is None else self.certify(mass=mass, speed=speed)
        if report is not None and not report.stable:
            why = f"the margin is {report.margin:.4g} /s; the highest safe speed is {report.max_speed:.4g}"
            if report.margin >= 0.0:
                why = f"held between rows, its gains let V grow by {report.held_growth - 1.0:.2g}; resample it finer"
            remedy = f"{why}, or filter the stiffness and give no mass here"
            raise checks.refusal(speed, "speed", "certified to be stable", remedy)
        acceleration = None if self.acceleration is None else self.acceleration * speed**2
        return replace(self, time=self.time / speed, velocity=self.velocity * speed, acceleration=acceleration)

    def with_inertia(self, mass: Any, damping_ratio: float = 1.0, *, law: Any = None) -> "Schedule":
        """Schedule for a robot of this inertia: with it, and with the damping that gives all modes this ratio.

        ``D = 2 zeta M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2`` at every row, as
        :func:`~torch_pbd.control.damping_from_stiffness`. A torque-controlled arm moves with its operational inertia:
        damping made for 1 kg leaves a Panda with a ratio of 0.26.

        Parameters
        ----------
        mass : float, array_like of shape (d, d) or (n, d, d), or callable
            In kg, for poses also kg m and kg m^2, in world axes; or a function of time (n,), in s, that returns it.
        damping_ratio : float, default=1.0
            Ratio zeta; 1 is critical.
        law : StiffnessLaw, default=None
            Makes the stiffness anew, from the covariance and the inertia of each row, softer where the model knows
            less, as on_unknown="soft". One with effort="match" matches it to this inertia. None keeps the stiffness.

        Raises
        ------
        ValueError
            If a matrix is not symmetric and positive definite, or the ratio is negative.
        """
        heavy = replace(self, mass=mass(self.time) if callable(mass) else mass)
        return replace(heavy, **rows.damped_rows(heavy, damping_ratio, law))

    def transform(
        self, rotation: ArrayLike, translation: ArrayLike | None = None, *, frame: str | None = None
    ) -> "Schedule":
        """Schedule in another frame of the world, into which ``R x + t`` brings the positions x.

        Parameters
        ----------
        rotation : array_like of shape (p, p) or (4,)
            Matrix R, or for p = 3 a unit quaternion w x y z.
        translation : array_like of shape (p,), default=None
            In ``units``; None is none.
        frame : str, default=None
            Name of the new frame.

        Raises
        ------
        ValueError
            If the matrix is no rotation, positions are joint angles, or axes have limits of their own.
        """
        return replace(self, **rows.turned_rows(self, rotation, translation), frame=frame)

    def certify(self, *, mass: Any = None, **options: Any) -> "StabilityReport":
        """:func:`torch_pbd.control.certify` of this schedule, whose options it takes; no mass is its own, or 1 kg."""
        from torch_pbd.control.stability.certify import certify  # here: it needs torch, a schedule does not

        return certify(self, mass=mass, **options)

    def diagonal(self) -> tuple["Schedule", rows.DiagonalLoss]:
        """Schedule with diagonal stiffness and damping, for controllers that take no other, and what that loses."""
        stiffness, damping, loss = rows.diagonal_gains(self)
        return replace(self, stiffness=stiffness, damping=damping), loss

    def plot(self) -> Any:
        """Draw motion, standard deviation and stiffness; returns the list of matplotlib Axes of a new figure."""
        from torch_pbd.plotting.display import plot_schedule  # here: it needs matplotlib, a schedule does not

        return plot_schedule(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file, in the format of its suffix: .npz, .json or .csv.

        All of them hold everything to the last bit, with a version and a checksum. In .csv the labels are lines
        ``# key: JSON`` before the header, matrices their upper triangles, ``stiffness[x][y]``. The file appears
        whole or not at all, and replaces one that is there.

        Raises
        ------
        ValueError, OSError
            If the suffix is another, or the file would be larger than 1 GiB; if it cannot be written.
        """
        write_schedule(Path(path), self._arrays(), self._labels())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file of `save`; nothing in it is executed.

        Raises
        ------
        FileNotFoundError, ValueError
            If there is no such file; if its suffix is none of .npz, .json and .csv.
        ModelFileError
            If the file is torn, changed, of a newer version, or does not hold a schedule. A .csv that was
            edited on purpose loads once its line ``# sha256: ...`` is deleted.
        """
        return read_schedule(Path(path), build=cls)

    def _arrays(self) -> dict[str, Any]:
        return {name: array for name in SHAPES if isinstance(array := getattr(self, name), np.ndarray)}

    def _labels(self) -> dict[str, Any]:
        mass = None if isinstance(self.mass, np.ndarray) else self.mass
        return {name: getattr(self, name) for name in LABELS} | {"mass": mass, "provenance": dict(self.provenance)}
