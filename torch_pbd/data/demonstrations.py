"""Immutable container of K recordings of one task, checked once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import check_overlap, unit_phases
from torch_pbd.data.description import Description, describe
from torch_pbd.data.editing import Alignment, Editing
from torch_pbd.data.poses import as_chart, as_columns, as_reference, find_suspects, unwrapped
from torch_pbd.data.recordings import Missing, as_names, as_recordings, as_units, frozen, preview
from torch_pbd.data.units import TIMES, check_unit
from torch_pbd.data.wanted import OPTIONS, Wanted, check_options, column_names
from torch_pbd.exceptions import InvalidParameterError


class Demonstration(NamedTuple):
    """One recording: ``time`` (T,) and ``position`` (T, d), both read-only."""

    time: Floats
    position: Floats


@final
@dataclass(frozen=True, init=False, eq=False, repr=False)
class Demonstrations(Editing):
    """K recordings of one task, of any lengths and sampling times, with the same d outputs.

    Immutable: arrays are read-only float64 copies, and every method returns a new container. Axis order is
    (demonstration, step, output).

    Parameters
    ----------
    times : sequence of K array_like of shape (T_k,), or array_like of shape (T,)
        Strictly increasing times of the samples, or one array that all demonstrations share. Whole numbers beyond
        2**53 (stamps in ns since 1970), which float64 cannot hold, are counted from the first of all: steps are exact.
    positions : sequence of K array_like of shape (T_k, d), or array_like of shape (K, T, d)
        Recorded outputs in d columns. Demonstrations of one output may be 1-D.
    names : sequence of d str, default=None
        Names of the outputs; None calls them y0, y1, ...
    units : str or sequence of d str, default=None
        Units of the outputs; one string is the unit of all of them. Known are km, m, dm, cm, mm, um, rad and deg;
        other words ("pixels") are units of their own. With ``rotation``, they are units of the other columns.
    frame : str, default=None
        Name of the coordinate frame.
    time_unit : str, default="s"
        h, min, s, ms, us or ns; "1" for phase.
    alignment : {"phase", "dtw"}, default=None
        Method by which `align` brought the demonstrations onto one grid; None if it did not.
    missing : {"raise", "drop"}, default="raise"
        "drop" removes samples whose time or a position is NaN or masked, and warns of their number
        (``MissingDataWarning``); each demonstration then has its own times. Infinity is an error.
    rotation : sequence of 4 str, default=None
        Names of the columns of a unit quaternion in the order w x y z, which data cannot tell from x y z w. They become
        the last three outputs rx, ry, rz in rad: y = Log(R0' R), around the Frechet mean R0 of all samples at common
        phases.
    angles : str or sequence of str, default=None
        Outputs in rad or deg to unwrap, along time and between demonstrations.
    rotation_reference : array_like of shape (4,), default=None
        Reference R0 of recordings whose last three outputs already are such a rotation.

    Attributes
    ----------
    times, positions, names, units, frame, time_unit, alignment, rotation_reference
        Parameters as tuples of K read-only arrays and tuples of d strings; the reference is None without rotation.
    suspects : tuple of str
        Warnings about outputs without a meaningful mean, such as wrapped angles, each with its remedy.

    Raises
    ------
    ValueError
        If there is no demonstration, lengths or numbers of outputs disagree, one has fewer than two (remaining)
        samples, a value is not a finite real number, times do not increase strictly or are too coarse to separate
        samples, a unit is misspelled ("MM", "sec"), or a quaternion is not of norm 1 up to rounding in files or more
        than 150 degrees from the mean.

    Warns
    -----
    UserWarning
        If there are suspects, or rotations more than 120 degrees from the mean.

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
        rotation: Sequence[str] | None = None,
        angles: str | Sequence[str] | None = None,
        rotation_reference: ArrayLike | None = None,
    ) -> None:
        if not isinstance(time_unit, str) or not time_unit:
            raise checks.refusal(time_unit, "time_unit", "the unit of the times", "'s', or '1' for phase")
        check_unit(time_unit, "time_unit", TIMES)
        checks.text(frame, "frame", optional=True)
        if alignment is not None:
            checks.choice(alignment, "alignment", Alignment)
        grids, outputs = as_recordings(times, positions, missing)
        labels, reference = as_names(names, outputs[0].shape[1]), None
        if rotation is not None:
            if rotation_reference is not None:
                must = "None where rotation= names quaternions"
                raise checks.refusal(rotation_reference, "rotation_reference", must)
            grids, outputs, labels, own, reference = as_chart(grids, outputs, labels, units, rotation, missing)
        else:
            own = as_units(units, len(labels))
            if rotation_reference is not None:
                reference = as_reference(rotation_reference, grids, outputs, labels, own)
        if angles is not None:
            outputs = tuple(unwrapped(grids, outputs, labels, own, angles))
        outputs = tuple(map(frozen, outputs))
        # A frozen class can set its attributes only through its dictionary.
        vars(self).update(times=grids, positions=outputs, names=labels, units=own, rotation_reference=reference)
        vars(self).update(frame=frame, time_unit=time_unit, alignment=alignment)
        vars(self)["suspects"] = find_suspects(outputs, labels, own)
        if self.suspects:
            checks.warn(" ".join(self.suspects))

    @property
    def n_outputs(self) -> int:
        """Number of outputs d."""
        return len(self.names)

    @property
    def n_steps(self) -> tuple[int, ...]:
        """Number of samples T_k of each demonstration."""
        return tuple(map(len, self.times))

    @property
    def is_aligned(self) -> bool:
        """Whether all demonstrations share exactly the same times."""
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
        """One demonstration by its index, or several by a slice, a list of indices or a mask."""
        chosen = np.arange(len(self))[index]
        if chosen.ndim == 0:
            return Demonstration(self.times[chosen], self.positions[chosen])
        times, positions = [self.times[k] for k in chosen], [self.positions[k] for k in chosen]
        return self._replace(times, positions, anew=bool(self.suspects))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Demonstrations):
            return NotImplemented
        labels, others = ((d.names, d.units, d.frame, d.time_unit, len(d)) for d in (self, other))
        arrays = ((d.rotation_reference, *d.times, *d.positions) for d in (self, other))
        return labels == others and all(map(np.array_equal, *arrays))

    def __repr__(self) -> str:
        n_steps = "..".join(map(str, sorted({min(self.n_steps), max(self.n_steps)})))
        outputs = f"outputs={self.names}" if self.n_outputs <= 6 else f"n_outputs={self.n_outputs}"
        return (
            f"Demonstrations(n_demos={len(self)}, n_steps={n_steps}, {outputs}, "
            f"time_unit={self.time_unit!r}, aligned={self.is_aligned})"
        )

    def stack(self, input: Literal["time", "phase"] = "time") -> tuple[Floats, Floats, NDArray[np.intp]]:
        """All samples as arrays for scikit-learn's estimators, without names, units and rotations.

        Parameters
        ----------
        input : {"time", "phase"}, default="time"
            "phase" maps the time of each demonstration affinely onto 0..1. Grids that differ only by offset and
            duration become equal to the last bit, by which estimators recognize aligned data.

        Returns
        -------
        X : ndarray of shape (n, 1)
            Time in ``time_unit``, or phase. Times raise a ValueError if all demonstrations share less than half of
            their median duration.
        y : ndarray of shape (n, d)
        groups : ndarray of shape (n,)
            Index of the demonstration, for GroupKFold and LeaveOneGroupOut.
        """
        checks.choice(input, "input", ("time", "phase"))
        if input == "time":
            check_overlap(self.times, self.time_unit)
        X = np.concatenate(self.times if input == "time" else unit_phases(self.times))[:, np.newaxis]
        return X, np.concatenate(self.positions), np.repeat(np.arange(len(self)), self.n_steps)

    def split(self, k: int | Sequence[int]) -> tuple["Demonstrations", "Demonstrations"]:
        """Split into ``(train, test)``: ``test`` has the demonstrations of indices ``k``, ``train`` all others."""
        held_out = np.zeros(len(self), dtype=bool)
        try:
            held_out[np.asarray(k)] = True
        except IndexError as error:
            raise checks.refusal(k, "k", f"one or some of the demonstrations, numbered 0 to {len(self) - 1}") from error
        if held_out.all():
            raise InvalidParameterError(f"k leaves out all {len(self)} demonstrations: both parts need some.")
        return self[~held_out], self[held_out]

    def to_array(self) -> Floats:
        """Positions (K, T, d) of aligned demonstrations; a ValueError if they do not share their times."""
        if not self.is_aligned:
            are = f"not aligned (lengths {preview(self.n_steps)}, or times that differ)"
            raise InvalidParameterError(f"the demonstrations are {are}: use .align(), or .resample(n) for equal times.")
        return np.stack(self.positions)

    def plot(self, outputs: Sequence[int | str] | None = None, *, ax: Any = None) -> Any:
        """Plot all demonstrations: two or three outputs as a path, one or more than three over time.

        ``outputs`` are indices or names of at most nine, by default the first nine. ``ax`` are the matplotlib axes to
        draw into and return, with projection "3d" for three outputs; None makes a pyplot figure.
        """
        from torch_pbd.plotting.display import plot_movements  # here: matplotlib takes a while to import

        return plot_movements(self, outputs, ax)

    @classmethod
    def from_frame(cls, table: Any, **options: Any) -> "Demonstrations":
        """Demonstrations from a table with one row per sample, in the order in which they first appear.

        The table is of pandas, polars, pyarrow or another library that narwhals supports; its index is ignored. The
        options are those of `torch_pbd.data.load_demonstrations`, from ``outputs`` to ``from_start``.
        """
        import narwhals

        check_options(options, [name for name in OPTIONS if name != "max_bytes"], "frames")
        try:
            rows = narwhals.from_native(table, eager_only=True, pass_through=True)
        except narwhals.exceptions.DuplicateError as error:
            raise InvalidParameterError(f"table must have one column of each name: rename. {error}") from error
        if not isinstance(rows, narwhals.DataFrame):
            must = "a dataframe of pandas, polars, pyarrow or alike, with its rows"
            raise checks.refusal(table, "table", must, "collect() lazy ones")
        if not all(isinstance(name, str) for name in rows.columns):
            raise checks.refusal(rows.columns, "table.columns", "texts", "join levels, ['_'.join(c) for c in columns]")
        wanted = Wanted(**options)
        known = {name: column_names(name, rows.get_column(name)[:1].to_numpy().shape) for name in rows.columns}
        chosen = wanted.choose(known, demo="demo", time="time")
        signals = {name: rows.get_column(name).to_numpy() for name in chosen.signals}
        [content] = wanted.since_first([wanted.read_rows(chosen, signals)])
        return wanted.finish([cls(**content)])

    def to_frame(self, library: Any = "pandas") -> Any:
        """Table of one row per sample with columns demo, time and the outputs; rotations are quaternions qw to qz.

        The table is of an installed ``library``: "pandas", "polars", "pyarrow", or such a module.
        """
        import narwhals

        names, columns = as_columns(self)
        table = {"demo": np.repeat(np.arange(len(self)), self.n_steps), "time": np.concatenate(self.times)}
        table |= zip(names, np.concatenate(columns).T, strict=True)
        return narwhals.from_dict(table, backend=library).to_native()

    def describe(self) -> Description:
        """Description of the recordings: tables to print, and likely ``mistakes``."""
        return describe(self, {})
