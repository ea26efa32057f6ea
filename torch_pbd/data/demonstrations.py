"""The container: K recordings of one task, checked once, never changed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import check_overlap, interpolate, on_common_phases, unit_phases
from torch_pbd.data.editing import Editing
from torch_pbd.data.recordings import MIN_SAMPLES, Missing, as_names, as_recordings, as_time_unit, as_units, preview
from torch_pbd.data.units import find_suspects
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_much

Alignment = Literal["phase", "dtw"]

MAX_DEFAULT_STEPS = 200
"""Most points `Demonstrations.align` takes of its own accord: dynamic time warping takes time in their square."""


class Demonstration(NamedTuple):
    """One recording: ``time`` (T,) and ``position`` (T, d), both read-only."""

    time: Floats
    position: Floats


@final
@dataclass(frozen=True, init=False, eq=False, repr=False)
class Demonstrations(Editing):
    """K recordings of one task, of any lengths and sampling times, with the same d outputs.

    The container is immutable: its arrays are read-only float64 copies, and every method returns a new one.
    Axis order is (demonstration, step, output).

    Parameters
    ----------
    times : sequence of K array_like of shape (T_k,), or array_like of shape (T,)
        Strictly increasing times of the samples, or one array that all demonstrations share. Whole numbers beyond
        2**53 (stamps in ns since 1970), which float64 cannot hold, are counted from the first of all: steps are exact.
    positions : sequence of K array_like of shape (T_k, d), or array_like of shape (K, T, d)
        What was recorded. Demonstrations of one output may be 1-D.
    names : sequence of d str, default=None
        Names of the outputs; None calls them y0, y1, ...
    units : str or sequence of d str, default=None
        Units of the outputs; one string is the unit of all of them. Known are km, m, dm, cm, mm, um, rad and deg;
        other words ("pixels") are units of their own.
    frame : str, default=None
        Name of the coordinate frame.
    time_unit : str, default="s"
        Unit of ``times``: h, min, s, ms, us, ns; "1" for phase.
    alignment : {"phase", "dtw"}, default=None
        How `align` brought the demonstrations onto one grid; None where it did not.
    missing : {"raise", "drop"}, default="raise"
        "drop" leaves out samples of which the time or a position is NaN or masked, and warns
        (`MissingDataWarning`) of how many; each demonstration then has its own times. Infinity is an error.

    Attributes
    ----------
    times, positions, names, units, frame, time_unit, alignment
        As above: tuples of K read-only arrays, tuples of d strings.
    suspects : tuple of str
        Sentences on outputs that have no mean as they are, each with its remedy.

    Raises
    ------
    ValueError
        If there is no demonstration, lengths or numbers of outputs disagree, a demonstration has (left) fewer than two
        samples, a value is not a finite real number, times do not increase strictly or are stored too coarsely to tell
        samples apart, a name has control characters, or a unit is a known one in another spelling ("MM", "sec").

    Warns
    -----
    UserWarning
        If four outputs are unit quaternions, or one is an angle that jumps by a turn: these have no mean as they are.

    Examples
    --------
    >>> import numpy as np
    >>> from torch_pbd.data import Demonstrations
    >>> recorded = Demonstrations([[0.0, 1.0, 2.0], [0.0, 2.0]], [[0.0, 1.0, 4.0], [0.0, 4.0]], names=["x"])
    >>> recorded
    Demonstrations(n_demos=2, n_steps=2..3, outputs=('x',), time_unit='s', aligned=False)
    >>> recorded.align(n=3).to_array()[:, :, 0]
    array([[0., 1., 4.],
           [0., 2., 4.]])
    """

    times: tuple[Floats, ...]
    positions: tuple[Floats, ...]
    names: tuple[str, ...]
    units: tuple[str, ...] | None
    frame: str | None
    time_unit: str
    alignment: Alignment | None
    suspects: tuple[str, ...]

    def __init__(
        self,
        times: ArrayLike | Sequence[ArrayLike],
        positions: ArrayLike | Sequence[ArrayLike],
        *,
        names: Sequence[str] | None = None,
        units: str | Sequence[str] | None = None,
        frame: str | None = None,
        time_unit: str = "s",
        alignment: Alignment | None = None,
        missing: Missing = "raise",
    ) -> None:
        times_, positions_ = as_recordings(times, positions, missing)
        d = positions_[0].shape[1]
        names_, units_ = as_names(names, d), as_units(units, d)
        # A frozen class sets its attributes by its dictionary.
        vars(self).update(
            times=times_,
            positions=positions_,
            names=names_,
            units=units_,
            frame=checks.text(frame, "frame", optional=True),
            time_unit=as_time_unit(time_unit),
            alignment=alignment if alignment is None else checks.choice(alignment, "alignment", Alignment),
            suspects=find_suspects(positions_, names_, units_),
        )
        if self.suspects:
            checks.warn(" ".join(self.suspects))

    @property
    def n_outputs(self) -> int:
        """Number of outputs d."""
        return self.positions[0].shape[1]

    @property
    def n_steps(self) -> tuple[int, ...]:
        """Number of samples T_k of each demonstration."""
        return tuple(map(len, self.times))

    @property
    def is_aligned(self) -> bool:
        """Whether all demonstrations share exactly one grid of times."""
        return all(np.array_equal(time, self.times[0]) for time in self.times)

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Demonstration]:
        return map(Demonstration, self.times, self.positions)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> "Demonstrations": ...
    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> "Demonstration | Demonstrations":
        """One demonstration by its number; several by a slice, a list of numbers or a mask."""
        chosen = np.arange(len(self))[index]
        if chosen.ndim == 0:
            return Demonstration(self.times[chosen], self.positions[chosen])
        times, positions = [self.times[k] for k in chosen], [self.positions[k] for k in chosen]
        suspects = find_suspects(positions, self.names, self.units) if self.suspects else ()
        return self._replace(times, positions, suspects=suspects)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Demonstrations):
            return NotImplemented
        labels = ("n_steps", "names", "units", "frame", "time_unit")
        arrays = zip((*self.times, *self.positions), (*other.times, *other.positions), strict=True)
        return all(getattr(self, name) == getattr(other, name) for name in labels) and all(
            np.array_equal(mine, theirs) for mine, theirs in arrays
        )

    def __repr__(self) -> str:
        shortest, longest = min(self.n_steps), max(self.n_steps)
        n_steps = f"{longest}" if shortest == longest else f"{shortest}..{longest}"
        outputs = f"outputs={self.names}" if self.n_outputs <= 6 else f"n_outputs={self.n_outputs}"
        return (
            f"Demonstrations(n_demos={len(self)}, n_steps={n_steps}, {outputs}, "
            f"time_unit={self.time_unit!r}, aligned={self.is_aligned})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # By way of __init__: NumPy forgets that an array is read-only when it is pickled or copied.
        return _rebuild, (self.times, self.positions, vars(self))

    def stack(self, input: Literal["time", "phase"] = "time") -> tuple[Floats, Floats, NDArray[np.intp]]:
        """All samples below each other, as scikit-learn's estimators want them.

        Parameters
        ----------
        input : {"time", "phase"}, default="time"
            "phase" maps the time of each demonstration affinely onto 0..1. Rows of demonstrations whose grids
            differ only by offset and duration repeat to the last bit, by which estimators know aligned data.

        Returns
        -------
        X : ndarray of shape (n, 1)
            Time in ``time_unit``, or phase.
        y : ndarray of shape (n, d)
        groups : ndarray of shape (n,)
            Number of the demonstration, for GroupKFold and LeaveOneGroupOut.

        Raises
        ------
        ValueError
            By time, if what all demonstrations have in common is shorter than half of their median duration.
        """
        checks.choice(input, "input", ("time", "phase"))
        if input == "time":
            check_overlap(self.times, self.time_unit)
        inputs = self.times if input == "time" else unit_phases(self.times)
        groups = np.repeat(np.arange(len(self)), self.n_steps)
        return np.concatenate(inputs)[:, np.newaxis], np.concatenate(self.positions), groups

    def to_array(self) -> Floats:
        """Positions (K, T, d) of aligned demonstrations; ValueError if they do not share one grid of times."""
        if not self.is_aligned:
            raise InvalidParameterError(
                f"the demonstrations are not aligned (lengths {preview(self.n_steps)}, or times that differ): use "
                ".align() for a common phase, or .resample(n) where all cover the same time."
            )
        return np.stack(self.positions)

    def resample(self, n: int) -> "Demonstrations":
        """Each demonstration at ``n`` points evenly spaced over its own time, by linear interpolation.

        Demonstrations that start and end at the same times are aligned afterwards.
        """
        grids = [np.linspace(time[0], time[-1], _checked_n(n)) for time in self.times]
        return self._replace(grids, list(map(interpolate, self.times, self.positions, grids)))

    def align(self, method: Literal["phase", "dtw"] = "phase", n: int | None = None) -> "Demonstrations":
        """All demonstrations on one grid of phases, evenly spaced over 0..1; ``time_unit`` becomes "1".

        Parameters
        ----------
        method : {"phase", "dtw"}, default="phase"
            "phase" is linear time normalization. "dtw" then takes differences of timing out by dynamic time warping
            (``torch_pbd.data.alignment.dtw_warps``), keeping the ends of each demonstration and the mean timing of all.
            It also takes for timing what only looks like it: use it where the shape is what matters, and not to predict
            new demonstrations, in which the timing comes back (measured: 3.7 nats a step worse). It compares positions
            in their units; outputs whose ``units`` differ are compared in standard deviations.
        n : int, default=None
            Number of phases; None takes the median number of samples, at most 200. "dtw" takes time and memory in
            proportion to its square.

        Returns
        -------
        Demonstrations
            Aligned.
        """
        checks.choice(method, "method", Alignment)
        n = _checked_n(min(round(float(np.median(self.n_steps))), MAX_DEFAULT_STEPS) if n is None else n)
        grid, positions = on_common_phases(self.times, self.positions, method, n, self.units)
        # Timing that was taken out stays out, whatever is done to the demonstrations afterwards.
        alignment = "dtw" if "dtw" in (method, self.alignment) else "phase"
        return self._replace(grid, positions, time_unit="1", alignment=alignment)

    def plot(self, outputs: Sequence[int | str] | None = None, *, ax: Any = None) -> Any:
        """Draw every demonstration: two or three outputs against each other, one or more than three over time.

        Parameters
        ----------
        outputs : sequence of int or str, default=None
            Numbers or names of at most nine outputs; None is the first nine.
        ax : matplotlib.axes.Axes, default=None
            None makes a figure of pyplot. Of projection "3d" for three outputs.

        Returns
        -------
        matplotlib.axes.Axes, or a list of them
        """
        from torch_pbd.plotting import plot_movements  # here: matplotlib takes a while to import

        return plot_movements(self, outputs, ax)

    def _replace(self, times: Any, positions: Any, **changes: Any) -> "Demonstrations":
        return _rebuild(times, positions, {**vars(self), **changes})


def _rebuild(times: Any, positions: Any, attributes: dict[str, Any]) -> Demonstrations:
    """Demonstrations made of others, whose labels were checked and whose suspects were warned of."""
    rebuilt = object.__new__(Demonstrations)
    times, positions = as_recordings(times, positions, "raise")
    vars(rebuilt).update(attributes, times=times, positions=positions)
    return rebuilt


def _checked_n(n: int) -> int:
    checks.count(n, "n", least=MIN_SAMPLES)
    require_much(64.0 * n, what=f"n={n} points", remedy="Lower it.")
    return n
