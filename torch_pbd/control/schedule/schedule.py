"""The schedule of a controller: position, velocity, stiffness and damping over time, with the model's uncertainty."""

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
    """Position, velocity, stiffness and damping over time, with the underlying covariance.

    For positions alone d = p; for poses d = p + 3, and twists, wrenches and gains have positions first and rotations
    last, all in world axes. The stiffness acts on the deviation ``(x - x_d, Log(R R_d'))``, whose last three entries
    are a rotation vector in rad. Values between rows are defined by `resample`. A schedule is immutable, and its arrays
    are read-only float64 copies.

    Parameters
    ----------
    time : array_like of shape (n,)
        Times in s, strictly increasing, n >= 2.
    position : array_like of shape (n, p)
        Desired position in ``units``.
    velocity : array_like of shape (n, d)
        Desired velocity in ``units``/s, and rad/s for rotations.
    stiffness, damping : array_like of shape (n, d, d)
        Gains in N/m and N s/m, and for rotations Nm/rad and Nm s/rad; symmetric and positive semidefinite. Where the
        stiffness is singular, the damping must be positive definite: nothing else would stop the robot.
    covariance : array_like of shape (n, d, d)
        Covariance of the demonstrations, at the desired pose; symmetric and positive semidefinite.
    type1 : array_like of shape (n,)
        Type I uncertainty, the model's lack of data: 0 (on data) to 1 (the prior alone).
    acceleration : array_like of shape (n, d), default=None
        Desired acceleration in ``units``/s^2 and rad/s^2; None if unknown.
    orientation : array_like of shape (n, 4), default=None
        Desired orientation as unit quaternions w x y z that rotate tool vectors to the world; signs become continuous.
    names : sequence of d str, default=None
        Names of the outputs.
    units, frame : str, default="m", None
        Unit of the position, and name of the coordinate frame or None if unknown.
    stiffness_limits : (low, high), default=None
        Least and largest stiffness in N/m, each a number or d numbers: ``diag(low) <= K <= diag(high)``.
    covariance_of : {"position", "forcing"}, default="position"
        Quantity of the covariance; the forcing is that of eq. (18).
    mass : float, or array_like of shape (d, d) or (n, d, d), default=None
        Inertia that the damping was computed for: the virtual mass of an admittance in kg, or that of an arm along the
        schedule in kg, kg m and kg m^2, symmetric and positive definite.
    provenance : mapping, default={}
        JSON-compatible data about the origin of the schedule.

    Raises
    ------
    InvalidParameterError
        If an argument is invalid; it is a ValueError and names the row.
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
        """Number of outputs d: positions, plus three with an orientation."""
        return self.velocity.shape[1]

    @property
    def blocks(self) -> tuple[slice, ...]:
        """Slices of outputs that share a unit: the positions, and the rotation if there is an orientation."""
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
        # Copies go through the constructor, since pickling or copying makes NumPy arrays writable again.
        return partial(Schedule, **self._labels() | self._arrays()), ()

    def resample(self, rate: float | None = None, *, times: ArrayLike | None = None) -> "Schedule":
        """Rows at other times, all within the schedule.

        Stiffness, damping, covariance, mass, acceleration and type1 are piecewise linear, so that matrices stay
        symmetric, positive semidefinite and within their limits. The position is the cubic Hermite interpolation of
        positions and velocities, and the velocity its derivative, so that the two are consistent for the damping.
        Orientations are such cubics of the rotation vector from the row before.

        Parameters
        ----------
        rate : float, default=None
            Rate in Hz: rows every 1/rate from the first time on, and one at the end.
        times : array_like of shape (m,), default=None
            Times in s, strictly increasing, m >= 2; either this or ``rate``. Details between them are lost.

        Raises
        ------
        ValueError
            If not exactly one is given, ``rate`` leaves fewer than two rows, or a time is outside the schedule.
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
        """Schedule that is ``speed`` times as fast: time / speed, velocity * speed, same gains and masses.

        Parameters
        ----------
        speed : float
            Factor from 1e-9 to 1e9, by which the stiffness changes faster too.
        mass : float, array_like of shape (d, d) or (n, d, d), or callable, default=None
            Mass with which :func:`~torch_pbd.control.certify` checks the stability at the new speed; None for no check.

        Raises
        ------
        ValueError
            If ``speed`` is out of range, or no guarantee of the report holds at that speed with ``mass``.
        """
        # Speeds beyond these bounds, a year for a second, are mistakes; within, times and velocities keep their digits.
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
        """Schedule for a robot of this inertia, with damping that gives all modes this damping ratio.

        ``D = 2 zeta M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2`` at every row, as in
        :func:`~torch_pbd.control.damping_from_stiffness`. A torque-controlled arm moves with its operational-space
        inertia: damping for 1 kg leaves a Panda with a ratio of 0.26.

        Parameters
        ----------
        mass : float, array_like of shape (d, d) or (n, d, d), or callable
            Inertia in kg, for poses also kg m and kg m^2, in world axes; or a function of times (n,) in s.
        damping_ratio : float, default=1.0
            Damping ratio zeta; 1 is critical.
        law : StiffnessLaw, default=None
            Law that recomputes the stiffness from the covariance and inertia of each row, softer where data are
            missing, as on_unknown="soft"; effort="match" matches this inertia. None keeps the stiffness.

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
        """Schedule in another frame, to which ``R x + t`` maps positions x.

        Parameters
        ----------
        rotation : array_like of shape (p, p) or (4,)
            Matrix R, or for p = 3 a unit quaternion w x y z.
        translation : array_like of shape (p,), default=None
            Translation t in ``units``; None is zero.
        frame : str, default=None
            Name of the new frame.

        Raises
        ------
        ValueError
            If the matrix is not a rotation, positions are joint angles, or axes have limits of their own.
        """
        return replace(self, **rows.turned_rows(self, rotation, translation), frame=frame)

    def certify(self, *, mass: Any = None, **options: Any) -> "StabilityReport":
        """Stability report of :func:`torch_pbd.control.certify`, with its options; mass defaults to the schedule's."""
        from torch_pbd.control.stability.certify import certify  # here: it needs torch, a schedule does not

        return certify(self, mass=mass, **options)

    def diagonal(self) -> tuple["Schedule", rows.DiagonalLoss]:
        """Schedule with diagonal gains, for controllers that need them, and the error that this causes."""
        stiffness, damping, loss = rows.diagonal_gains(self)
        return replace(self, stiffness=stiffness, damping=damping), loss

    def plot(self) -> Any:
        """Plot motion, standard deviation and stiffness in a new figure; returns its list of matplotlib Axes."""
        from torch_pbd.plotting.display import plot_schedule  # here: it needs matplotlib, a schedule does not

        return plot_schedule(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file, in the format of its suffix: .npz, .json or .csv.

        Each format holds everything to the last bit, with a version and a checksum. A .csv has labels as lines
        ``# key: JSON`` before the header, and the upper triangles of matrices, ``stiffness[x][y]``. The file is
        written atomically and replaces an existing one.

        Raises
        ------
        ValueError, OSError
            If the suffix is not one of these, the file would exceed 1 GiB, or it cannot be written.
        """
        write_schedule(Path(path), self._arrays(), self._labels())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Load a file written by `save`; nothing in it is executed.

        Raises
        ------
        FileNotFoundError, ValueError
            If there is no such file, or its suffix is not .npz, .json or .csv.
        ModelFileError
            If the file is truncated, changed, of a newer version, or not a schedule. A .csv that was edited on
            purpose loads once its line ``# sha256: ...`` is deleted.
        """
        return read_schedule(Path(path), build=cls)

    def _arrays(self) -> dict[str, Any]:
        return {name: array for name in SHAPES if isinstance(array := getattr(self, name), np.ndarray)}

    def _labels(self) -> dict[str, Any]:
        mass = None if isinstance(self.mass, np.ndarray) else self.mass
        return {name: getattr(self, name) for name in LABELS} | {"mass": mass, "provenance": dict(self.provenance)}
