"""Demonstrations from tables, and joined, selected, in other units or cut."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.poses import as_columns, charted, mean_rotation, unwrapped, with_whole_rotation
from torch_pbd.data.recordings import MIN_SAMPLES, as_texts, preview
from torch_pbd.data.sampling import Resampling, still
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES, check_unit
from torch_pbd.data.wanted import OPTIONS, Wanted, check_options
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.rotations import Chart

if TYPE_CHECKING:
    from torch_pbd.data.description import Description


class Editing(Resampling):
    """Methods of `torch_pbd.data.Demonstrations`; abstract."""

    @classmethod
    def from_frame(cls, table: Any, **options: Any) -> Self:
        """Demonstrations from a table with one row per sample, in the order in which they first appear.

        Parameters
        ----------
        table : dataframe
            Table of pandas, polars, pyarrow or another library that narwhals supports; its index is ignored.
        **options
            Options of `torch_pbd.data.load_demonstrations`, from ``outputs`` to ``from_start``.

        Raises
        ------
        ValueError
            If it is not a dataframe, or lacks columns that the options name, or these hold no numbers.
        """
        import narwhals

        check_options(options, [name for name in OPTIONS if name != "max_bytes"], "frames")
        wanted = Wanted(**options)
        rows = narwhals.from_native(table, eager_only=True, pass_through=True)
        if not isinstance(rows, narwhals.DataFrame):
            must = "a dataframe of pandas, polars, pyarrow or alike, with its rows"
            raise checks.refusal(table, "table", must, "collect() lazy ones")
        chosen = wanted.choose({name: (name,) for name in rows.columns}, demo="demo", time="time")
        signals = {name: rows.get_column(name).to_numpy() for name in chosen.signals}
        return wanted.finish([cls(**wanted.read_rows(chosen, signals))])

    def to_frame(self, library: Any = "pandas") -> Any:
        """Table of one row per sample with columns demo, time and the outputs; rotations are quaternions qw to qz.

        Parameters
        ----------
        library : {"pandas", "polars", "pyarrow"} or module, default="pandas"
            Library of the table, which must be installed.
        """
        import narwhals

        names, columns = as_columns(self)
        table = {
            "demo": np.repeat(np.arange(len(self.times)), list(map(len, self.times))),
            "time": np.concatenate(self.times),
            **dict(zip(names, np.concatenate(columns).T, strict=True)),
        }
        return narwhals.from_dict(table, backend=library).to_native()

    @classmethod
    def concatenate(cls, parts: Iterable[Self]) -> Self:
        """Demonstrations of several sets in order; outputs, units, frame and unit of time must agree.

        Rotations around different references are converted to one chart, around the mean of all.
        """
        sets = [checks.instance(part, f"parts[{i}]", cls) for i, part in enumerate(parts)]
        if not sets:
            raise InvalidParameterError("parts is empty, must have at least one set of demonstrations.")
        for i, part in enumerate(sets):
            for label in ("names", "units", "frame", "time_unit"):
                mine, first = getattr(part, label), getattr(sets[0], label)
                if mine != first:
                    must = f"must be as parts[0], {first}: use .select() or .in_units()"
                    raise InvalidParameterError(f"parts[{i}] has {label} {mine}, {must}.")
        times, positions = ([a for part in sets for a in getattr(part, name)] for name in ("times", "positions"))
        alignment = sets[0].alignment if len({part.alignment for part in sets}) == 1 else None
        reference = sets[0].rotation_reference
        if not all(np.array_equal(part.rotation_reference, reference) for part in sets):
            pairs = [pair for part in sets for pair in zip(*part.to_poses(), strict=True)]
            places, turns = [place for place, _ in pairs], [turn for _, turn in pairs]
            reference = mean_rotation(times, turns)
            positions = charted(times, places, turns, reference)
        return sets[0]._replace(times, positions, anew=True, alignment=alignment, rotation_reference=reference)

    def to_poses(self) -> tuple[list[Floats], list[Floats]]:
        """Poses as positions and unit quaternions, where the last three outputs are a rotation.

        Returns
        -------
        positions : list of K ndarray of shape (T_k, d - 3)
        quaternions : list of K ndarray of shape (T_k, 4)
            Unit quaternions w x y z, whose signs are continuous along time and between demonstrations.
        """
        if self.rotation_reference is None:
            raise InvalidParameterError("the demonstrations have no rotation: name its columns by rotation=, w x y z.")
        # w >= 0 relative to the reference makes signs continuous.
        turns = [Chart(self.rotation_reference).exp(position[:, -3:]) for position in self.positions]
        return [position[:, :-3] for position in self.positions], turns

    def select(self, outputs: str | Sequence[str]) -> Self:
        """Demonstrations with the selected outputs, in the order given; a rotation is kept whole and last."""
        chosen = as_texts(outputs, "outputs")
        if not 0 < len(chosen) == len(set(chosen) & set(self.names)):
            raise checks.refusal([*chosen], "outputs", f"different ones of {preview(self.names)}")
        chosen, reference = with_whole_rotation(chosen, self.names, self.rotation_reference)
        kept = [self.names.index(name) for name in chosen]
        positions = [position[:, kept] for position in self.positions]
        units = self.units and tuple(self.units[i] for i in kept)
        labels = {"names": chosen, "units": units, "rotation_reference": reference}
        return self._replace(self.times, positions, anew=True, **labels)

    def unwrap(self, angles: str | Sequence[str]) -> Self:
        """Demonstrations with the named angles unwrapped, along time and between demonstrations."""
        return self._replace(
            self.times, unwrapped(self.times, self.positions, self.names, self.units, angles), anew=True
        )

    def in_units(self, unit: str | None = None, time_unit: str | None = None) -> Self:
        """Demonstrations in another unit of length or angle, and of time.

        Parameters
        ----------
        unit : str, default=None
            New unit of all outputs of its kind, length or angle; other outputs, and rotations, stay as they are.
        time_unit : str, default=None
            New unit of time: h, min, s, ms, us or ns.
        """
        times, positions, units = self.times, self.positions, self.units
        if unit is not None:
            check_unit(unit, "unit", LENGTHS | ANGLES)
            before, kind = self.units or (), LENGTHS if unit in LENGTHS else ANGLES
            n_free = len(self.names) - 3 * (self.rotation_reference is not None)  # a rotation is in rad
            units = tuple(unit if i < n_free and own in kind else own for i, own in enumerate(before))
            if unit not in units[:n_free]:
                must = f"of the kind of one of the outputs, which are in {before or 'no known units (give units=)'}"
                raise checks.refusal(unit, "unit", must)
            here, there = (np.array([kind.get(own, 1.0) for own in each]) for each in (before, units))
            positions = tuple(_convert(position, here, there) for position in positions)
        if time_unit is not None:
            if time_unit not in TIMES or self.time_unit not in TIMES:
                must = f"one of {', '.join(TIMES)}, as that of these demonstrations, {self.time_unit}"
                raise checks.refusal(time_unit, "time_unit", must)
            times = tuple(_convert(time, TIMES[self.time_unit], TIMES[time_unit]) for time in times)
        return self._replace(times, positions, units=units, time_unit=time_unit or self.time_unit)

    def cut(self, at: Literal["pauses"] | Sequence[tuple[float, float]] = "pauses", *, pause: float = 0.5) -> Self:
        """Split one long recording into several demonstrations.

        Where a column of a file labels them, use ``demo=`` of `torch_pbd.data.load_demonstrations`.

        Parameters
        ----------
        at : "pauses" or sequence of (start, end), default="pauses"
            Start and end of each demonstration in ``time_unit``; "pauses" splits at pauses.
        pause : float, default=0.5
            Shortest pause in ``time_unit``, during which all outputs stay within 2 % of their extent.
        """
        if len(self.times) != 1:
            raise InvalidParameterError(f"there are {len(self.times)} recordings, must be one to be cut, as [:1].")
        time, position = self.times[0], self.positions[0]
        if isinstance(at, str):
            checks.choice(at, "at", ("pauses",))
            moving = ~still(time, position, self, pause)
            edges = np.flatnonzero(np.diff(np.r_[False, moving, False]))
            spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= MIN_SAMPLES]
            if not spans:
                raise InvalidParameterError(f"nothing moves between pauses of {pause} {self.time_unit}: lower pause.")
        else:
            spans = [_span(time, start_end, i) for i, start_end in enumerate(at)]
        return self._replace([time[a:b] for a, b in spans], [position[a:b] for a, b in spans], suspects=())

    def trim(self, method: Literal["still"] = "still", *, pause: float = 0.5) -> Self:
        """Demonstrations without stillness at their ends that lasts longer than a ``pause`` as in :meth:`cut`."""
        checks.choice(method, "method", ("still",))
        times, positions = [], []
        for time, position in zip(self.times, self.positions, strict=True):
            moving = np.flatnonzero(~still(time, position, self, pause))
            # One still sample is kept at each end, where the movement starts and stops.
            span = slice(max(moving[0] - 1, 0), moving[-1] + 2) if len(moving) else slice(None)
            times.append(time[span])
            positions.append(position[span])
        return self._replace(times, positions)

    def describe(self) -> "Description":
        """Description of the recordings: tables to print, and likely ``mistakes``."""
        from torch_pbd.data.description import describe

        return describe(self)


def _span(time: Floats, start_end: Any, i: int) -> tuple[int, int]:
    ends = checks.real_floats(start_end, f"at[{i}]")
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise checks.refusal(start_end, f"at[{i}]", "a start and an end after it, in the unit of the times")
    a, b = np.searchsorted(time, ends[0]), np.searchsorted(time, ends[1], side="right")
    if b - a < MIN_SAMPLES:
        holds = f"at[{i}] holds {b - a} samples between {ends[0]:g} and {ends[1]:g}, must hold {MIN_SAMPLES}"
        raise InvalidParameterError(f"{holds}: the recording goes from {time[0]:g} to {time[-1]:g}.")
    return int(a), int(b)


def _convert(values: Floats, here: Any, there: Any) -> Floats:
    """Values in another unit, by division where the factor is a whole number: 1000 is exact and 0.001 is not."""
    return np.where(here >= there, values * (here / there), values / (there / here))
