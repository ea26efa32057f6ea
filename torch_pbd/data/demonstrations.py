"""The container: K recordings of one task, checked once, never changed."""

import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd.data.alignment import (
    Floats,
    check_overlap,
    interpolate,
    on_common_phases,
    times_from_start,
    unit_phases,
)
from torch_pbd.data.missing import levels_to_caller
from torch_pbd.data.recordings import (
    as_mask,
    as_names,
    as_recordings,
    as_units,
    check_choice,
    check_frame_and_unit,
    check_n_steps,
    preview,
)
from torch_pbd.data.suspects import find_suspects

Alignment = Literal["phase", "dtw"]
Missing = Literal["raise", "drop"]
MAX_DEFAULT_STEPS = 200
"""Most points `Demonstrations.align` takes of its own accord."""


class Demonstration(NamedTuple):
    """One recording: ``time`` (T,) and ``position`` (T, d), both read-only."""

    time: Floats
    position: Floats


@final
class Demonstrations:
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
    missing : {"raise", "drop"}, default="raise"
        "drop" leaves out samples of which the time or a position is NaN or masked, and warns
        (`MissingDataWarning`) of how many; each demonstration then has its own times. Infinity is an error.

    Raises
    ------
    ValueError
        If there is no demonstration, if lengths or numbers of outputs disagree, if a demonstration has (left) fewer
        than two samples, if a value is not a finite real number, or if times do not increase strictly or are
        stored too coarsely to tell samples apart; or if a name has control characters, or a unit is a known one in
        another spelling ("MM", "millimeter", "sec").

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

    __slots__ = ("_alignment", "_frame", "_names", "_positions", "_suspects", "_time_unit", "_times", "_units")

    def __init__(
        self,
        times: ArrayLike | Sequence[ArrayLike],
        positions: ArrayLike | Sequence[ArrayLike],
        *,
        names: Sequence[str] | None = None,
        units: str | Sequence[str] | None = None,
        frame: str | None = None,
        time_unit: str = "s",
        missing: Missing = "raise",
    ) -> None:
        self._times, self._positions = as_recordings(times, positions, missing)
        d = self.n_outputs
        self._names = as_names([f"y{i}" for i in range(d)] if names is None else names, d)
        self._units = as_units(units, d)
        check_frame_and_unit(frame, time_unit)
        self._frame = frame
        self._time_unit = time_unit
        self._alignment: Alignment | None = None
        self._suspects = find_suspects(self._positions, self._names, self._units)
        if self._suspects:
            warnings.warn(" ".join(self._suspects), stacklevel=levels_to_caller())

    @property
    def times(self) -> tuple[Floats, ...]:
        """Times (T_k,) of each demonstration."""
        return self._times

    @property
    def positions(self) -> tuple[Floats, ...]:
        """Positions (T_k, d) of each demonstration."""
        return self._positions

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each output."""
        return self._names

    @property
    def units(self) -> tuple[str, ...] | None:
        """Unit of each output, or None where it was not told."""
        return self._units

    @property
    def frame(self) -> str | None:
        """Name of the coordinate frame."""
        return self._frame

    @property
    def time_unit(self) -> str:
        """Unit of the times; "1" where they are phases."""
        return self._time_unit

    @property
    def alignment(self) -> Alignment | None:
        """How `align` brought the demonstrations onto one grid; None where it did not."""
        return self._alignment

    @property
    def n_outputs(self) -> int:
        """Number of outputs d."""
        return self._positions[0].shape[1]

    @property
    def n_steps(self) -> tuple[int, ...]:
        """Number of samples T_k of each demonstration."""
        return tuple(len(time) for time in self._times)

    @property
    def is_aligned(self) -> bool:
        """Whether all demonstrations share exactly one grid of times."""
        first = self._times[0]
        return all(time is first or np.array_equal(time, first) for time in self._times)

    def __len__(self) -> int:
        return len(self._times)

    def __iter__(self) -> Iterator[Demonstration]:
        return map(Demonstration, self._times, self._positions)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> "Demonstrations": ...
    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> "Demonstration | Demonstrations":
        """One demonstration by its number; several by a slice, a list of numbers or a mask."""
        chosen = np.arange(len(self))[index]
        if chosen.ndim == 0:
            return Demonstration(self._times[chosen], self._positions[chosen])
        times, positions = [self._times[k] for k in chosen], [self._positions[k] for k in chosen]
        suspects = find_suspects(positions, self._names, self._units) if self._suspects else ()
        return self._replace(times, positions, suspects=suspects)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Demonstrations):
            return NotImplemented
        return self._labels() == other._labels() and all(
            len(mine) == len(theirs) and all(map(np.array_equal, mine, theirs))
            for mine, theirs in [(self._times, other._times), (self._positions, other._positions)]
        )

    def __repr__(self) -> str:
        shortest, longest = min(self.n_steps), max(self.n_steps)
        n_steps = f"{longest}" if shortest == longest else f"{shortest}..{longest}"
        outputs = f"outputs={self._names}" if self.n_outputs <= 6 else f"n_outputs={self.n_outputs}"
        return (
            f"Demonstrations(n_demos={len(self)}, n_steps={n_steps}, {outputs}, "
            f"time_unit={self._time_unit!r}, aligned={self.is_aligned})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # By way of __init__: NumPy forgets that an array is read-only when it is pickled or copied.
        return _rebuild, (self._times, self._positions, self._state())

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
        check_choice(input, ("time", "phase"), "input")
        if input == "time":
            check_overlap(self._times, self._time_unit)
        inputs = self._times if input == "time" else unit_phases(self._times)
        groups = np.repeat(np.arange(len(self)), self.n_steps)
        return np.concatenate(inputs)[:, np.newaxis], np.concatenate(self._positions), groups

    def to_array(self) -> Floats:
        """Positions (K, T, d) of aligned demonstrations.

        Raises
        ------
        ValueError
            If the demonstrations do not share one grid of times.
        """
        if not self.is_aligned:
            lengths = preview(self.n_steps)
            raise ValueError(
                f"the demonstrations are not aligned (lengths {lengths}, or times that differ): use .align() "
                "for a common phase, or .resample(n) where all cover the same time."
            )
        return np.stack(self._positions)

    def from_start(self) -> "Demonstrations":
        """The same with the times of each demonstration counted from its start.

        Grids that then differ by no more than their stamps resolve become one, as in ``stack("phase")``.
        """
        return self._replace(times_from_start(self._times), self._positions)

    def resample(self, n: int) -> "Demonstrations":
        """Each demonstration at ``n`` points evenly spaced over its own time, by linear interpolation.

        Demonstrations that start and end at the same times are aligned afterwards.
        """
        check_n_steps(n)
        grids = [np.linspace(time[0], time[-1], n) for time in self._times]
        return self._replace(grids, list(map(interpolate, self._times, self._positions, grids)))

    def align(self, method: Literal["phase", "dtw"] = "phase", n: int | None = None) -> "Demonstrations":
        """All demonstrations on one grid of phases, evenly spaced over 0..1; ``time_unit`` becomes "1".

        Parameters
        ----------
        method : {"phase", "dtw"}, default="phase"
            "phase" is linear time normalization. "dtw" then takes differences of timing out by dynamic time
            warping (`torch_pbd.data.alignment.dtw_warps`), keeping the ends of each demonstration and the
            mean timing of all. It also takes for timing what only looks like it: use it where the
            shape is what matters, and not to predict new demonstrations, in which the timing comes back
            (measured: 3.7 nats a step worse). It compares positions in their units; outputs whose ``units``
            differ are compared in standard deviations.
        n : int, default=None
            Number of phases; None takes the median number of samples, at most 200. "dtw" takes time and
            memory in proportion to its square.

        Returns
        -------
        Demonstrations
            Aligned.
        """
        check_choice(method, ("phase", "dtw"), "method")
        if n is None:
            n = min(round(float(np.median(self.n_steps))), MAX_DEFAULT_STEPS)
        check_n_steps(n)
        grid, positions = on_common_phases(self._times, self._positions, method, n, self._units)
        alignment = "dtw" if "dtw" in (method, self._alignment) else "phase"  # timing taken out is gone
        return self._replace(grid, positions, time_unit="1", alignment=alignment)

    def split(self, k: int | Sequence[int]) -> tuple["Demonstrations", "Demonstrations"]:
        """Leave demonstrations out: ``(train, test)``, where ``test`` has those numbered ``k``.

        Raises
        ------
        ValueError
            If there is no such demonstration, or if either part would be empty.
        """
        held_out = as_mask(k, len(self))
        return self[~held_out], self[held_out]

    def _labels(self) -> dict[str, Any]:
        return {
            "names": self._names,
            "units": self._units,
            "frame": self._frame,
            "time_unit": self._time_unit,
        }

    def _state(self) -> dict[str, Any]:
        return {**self._labels(), "alignment": self._alignment, "suspects": self._suspects}

    def _replace(self, times: Any, positions: Any, **changes: Any) -> "Demonstrations":
        return _rebuild(times, positions, {**self._state(), **changes})


def _rebuild(times: Any, positions: Any, labels: dict[str, Any]) -> Demonstrations:
    """Demonstrations made of others, whose labels were checked and of which all has been told."""
    rebuilt = object.__new__(Demonstrations)
    rebuilt._times, rebuilt._positions = as_recordings(times, positions, "raise")
    for name, value in {"alignment": None, "suspects": (), **labels}.items():
        setattr(rebuilt, f"_{name}", value)
    return rebuilt
