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
from torch_pbd.control.schedule.contents import ARRAY_DIMS, LABELS, checked_fields
from torch_pbd.control.schedule.files import read_schedule, write_schedule
from torch_pbd.control.schedule.rows import Between, tick_times
from torch_pbd.exceptions import InvalidParameterError

if TYPE_CHECKING:
    from torch_pbd.control.stability.report import StabilityReport

# Times and velocities keep their digits at any speed that is not a mistake: a year for a second, and the reverse.
_SLOWEST = 1e-9


@final
@dataclass(frozen=True)
class DiagonalLoss:
    """Loss of a controller that takes the diagonals of stiffness and damping only; all 0 if they are all there is.

    Attributes
    ----------
    stiffness_max, stiffness_median, damping_max, damping_median : float
        Frobenius norm of the entries off the diagonal over that of the whole; largest and median over time.
    displacement, time : float
        Largest ||x - x_diagonal|| / ||x|| over all forces and times, where the force displaces the robot by x
        with the whole stiffness, and when that is, in s. 1 is an error as large as the displacement.
    """

    stiffness_max: float
    stiffness_median: float
    damping_max: float
    damping_median: float
    displacement: float
    time: float

    def __str__(self) -> str:
        return (
            f"diagonal gains lose {self.stiffness_max:.1%} of the stiffness (median {self.stiffness_median:.1%}), "
            f"{self.damping_max:.1%} of the damping (median {self.damping_median:.1%}); displacements under a force "
            f"are off by up to {self.displacement:.1%}, at {self.time:.6g} s"
        )


@final
@dataclass(frozen=True, eq=False, repr=False)
class Schedule:
    """Position, velocity, stiffness and damping over time, with the covariance they come from.

    Between its rows it is what `resample` says. It is immutable; its arrays are read-only float64 copies.

    Parameters
    ----------
    time : array_like of shape (n,)
        In s, strictly increasing, n >= 2.
    position, velocity : array_like of shape (n, d)
        Desired, in ``units`` and ``units``/s.
    stiffness, damping : array_like of shape (n, d, d)
        In N/m and N s/m, symmetric and positive semidefinite. Where the stiffness is singular, the damping
        must be positive definite: nothing else would stop the robot.
    covariance : array_like of shape (n, d, d)
        Covariance of the demonstrations; symmetric and positive semidefinite.
    type1 : array_like of shape (n,)
        How little the model knows: 0 (on data) to 1 (the prior alone).
    names : sequence of d str, default=None
        Names of the outputs.
    units, frame : str, default="m", None
        Unit of the position, name of the coordinate frame; None where it is not known.
    stiffness_limits : (float, float), default=None
        Least and largest eigenvalue that the stiffness may have, in N/m.
    covariance_of : {"position", "forcing"}, default="position"
        Quantity that the covariance belongs to: a forcing is that of eq. (18).
    mass : float, default=None
        Virtual mass of the admittance that the damping was computed for, kg.
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
    names: tuple[str, ...] | None = None
    units: str | None = "m"
    frame: str | None = None
    stiffness_limits: tuple[float, float] | None = None
    covariance_of: str = "position"
    mass: float | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in checked_fields(vars(self)).items():
            object.__setattr__(self, name, value)

    @property
    def n_outputs(self) -> int:
        """Number of outputs d."""
        return self.position.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first row to the last, in s."""
        return float(self.time[-1] - self.time[0])

    def __len__(self) -> int:
        return len(self.time)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Schedule):
            return NotImplemented
        arrays = zip(self._arrays().values(), other._arrays().values(), strict=True)
        return self._labels() == other._labels() and all(np.array_equal(*pair) for pair in arrays)

    def __repr__(self) -> str:
        eigenvalues = np.linalg.eigvalsh(self.stiffness)
        outputs = f"names={self.names}" if self.names else f"n_outputs={self.n_outputs}"
        return (
            f"Schedule(n={len(self)}, {outputs}, time={self.time[0]:.6g}..{self.time[-1]:.6g} s, "
            f"stiffness={eigenvalues.min():.4g}..{eigenvalues.max():.4g} N/m, frame={self.frame!r})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies go through the constructor: NumPy forgets that an array is read-only when it is pickled or copied.
        return partial(Schedule, **self._arrays(), **self._labels()), ()

    def resample(self, rate: float | None = None, *, times: ArrayLike | None = None) -> "Schedule":
        """Rows at other times, all within the schedule.

        Stiffness, damping, covariance and type1 are piecewise linear, so they stay symmetric, positive semidefinite
        and within their limits. The position is the cubic of each interval through positions and velocities of its
        ends (Hermite), the velocity its derivative: damping acts on no motion that the position does not make.

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
            grid = np.append(first + tick_times(self.duration, rate, self.n_outputs)[:-1], last)
        else:
            grid = checks.array(times, "times", ("m",))
        checks.require((grid >= first) & (grid <= last), grid, "times", f"from {first!s} to {last!s} s")
        between = Between(self.time, grid)
        position, velocity = between.hermite(self.position, self.velocity)
        rows: dict[str, Any] = {name: between.linear(array) for name, array in self._arrays().items()}
        rows |= {"time": grid, "position": position, "velocity": velocity}
        return replace(self, **rows)

    def retime(self, speed: float, *, mass: Any = None) -> "Schedule":
        """Schedule that is ``speed`` times as fast: time / speed, velocity * speed, gains as they are.

        Parameters
        ----------
        speed : float
            From 1e-9 to 1e9; the stiffness rises that much faster too.
        mass : float or array_like of shape (d, d), default=None
            Mass of the admittance in kg, to certify the stability at the new speed. None: not checked.

        Raises
        ------
        ValueError
            If ``speed`` is not within these, or none of the guarantees of the report holds at it with ``mass``.
        """
        speed = checks.number(speed, "speed", least=_SLOWEST, most=1.0 / _SLOWEST)
        report = None if mass is None else self.certify(mass=mass, speed=speed)
        if report is not None and not report.stable:
            remedy = f"the margin is {report.margin:.4g} N/m/s; the highest safe speed is {report.max_speed:.4g}"
            if report.margin >= 0.0:
                remedy = f"held between rows, its gains let V grow by {report.held_growth - 1.0:.2g}; resample it finer"
            remedy = f"{remedy}, or filter the stiffness and give no mass here"
            raise checks.refusal(speed, "speed", "certified to be stable", remedy)
        return replace(self, time=self.time / speed, velocity=self.velocity * speed)

    def certify(self, *, mass: Any = None, **options: Any) -> "StabilityReport":
        """`torch_pbd.control.certify` of this schedule, whose options it takes; no mass is its own, or 1 kg."""
        from torch_pbd.control.stability.certify import certify  # here: it needs torch, a schedule does not

        return certify(self, mass=(self.mass or 1.0) if mass is None else mass, **options)

    def diagonal(self) -> tuple["Schedule", DiagonalLoss]:
        """Schedule with diagonal stiffness and damping, for controllers that take no other, and what that loses."""
        # The nearest diagonal matrix, in the Frobenius norm, is the diagonal itself. It lies between the least and the
        # largest eigenvalue, so within the limits too; rounding may leave it below zero.
        stiffness, damping = (np.eye(self.n_outputs) * np.maximum(gain, 0.0) for gain in (self.stiffness, self.damping))
        # x = K^-1 f and x_diagonal = D^-1 f differ by (I - D^-1 K) x: by its spectral norm, for the worst x.
        gains = np.diagonal(stiffness, axis1=1, axis2=2)[..., np.newaxis]
        coupling = (stiffness - self.stiffness) / np.where(gains > 0.0, gains, 1.0)
        displacement = np.linalg.norm(coupling, ord=2, axis=(1, 2))
        worst = int(displacement.argmax())
        loss = DiagonalLoss(
            *_relative_loss(self.stiffness, stiffness),
            *_relative_loss(self.damping, damping),
            displacement=float(displacement[worst]),
            time=float(self.time[worst]),
        )
        return replace(self, stiffness=stiffness, damping=damping), loss

    def plot(self) -> Any:
        """Draw motion, standard deviation and stiffness; returns the list of matplotlib Axes of a new figure."""
        from torch_pbd.plotting import plot_schedule  # here: it needs matplotlib, a schedule does not

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
        return {name: getattr(self, name) for name in ARRAY_DIMS}

    def _labels(self) -> dict[str, Any]:
        return {**{name: getattr(self, name) for name in LABELS}, "provenance": dict(self.provenance)}


def _relative_loss(matrices: Floats, diagonal: Floats) -> tuple[float, float]:
    """Frobenius norm of the entries lost relative to the whole, 0 where all is zero: largest and median over time."""
    whole = np.linalg.norm(matrices, axis=(1, 2))
    loss = np.linalg.norm(matrices - diagonal, axis=(1, 2)) / np.where(whole > 0.0, whole, 1.0)
    return float(loss.max()), float(np.median(loss))
