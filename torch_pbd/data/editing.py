"""What makes other demonstrations of some: from and to tables, other units, selected, joined, cut."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import times_from_start
from torch_pbd.data.pauses import still
from torch_pbd.data.recordings import MIN_SAMPLES, Missing, as_texts, preview
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES, check_unit, find_suspects
from torch_pbd.data.wanted import Wanted
from torch_pbd.exceptions import InvalidParameterError

if TYPE_CHECKING:
    from torch_pbd.data.description import Description


class Editing:
    """Methods of `torch_pbd.data.Demonstrations`; abstract."""

    times: tuple[Floats, ...]
    positions: tuple[Floats, ...]
    names: tuple[str, ...]
    units: tuple[str, ...] | None
    frame: str | None
    time_unit: str

    def _replace(self, times: Any, positions: Any, **changes: Any) -> Self:
        raise NotImplementedError

    def __getitem__(self, index: Any) -> Any:
        raise NotImplementedError

    @classmethod
    def from_frame(
        cls,
        table: Any,
        *,
        outputs: str | Sequence[str] | None = None,
        demo: str | None = None,
        time: str | None = None,
        units: str | Sequence[str] | None = None,
        time_unit: str | None = None,
        frame: str | None = None,
        rate: float | None = None,
        missing: Missing = "raise",
    ) -> Self:
        """Demonstrations of a table of pandas, polars, pyarrow or another library that narwhals knows, a row a sample.

        Parameters
        ----------
        table : dataframe
            An index is ignored.
        outputs, demo, time, units, time_unit, frame, rate, missing
            As in `torch_pbd.data.load_demonstrations`.

        Returns
        -------
        Demonstrations
            In the order in which they first appear.
        """
        import narwhals

        rows = narwhals.from_native(table, eager_only=True)
        wanted = Wanted(
            outputs=outputs,
            demo=demo,
            time=time,
            units=units,
            time_unit=time_unit,
            frame=frame,
            rate=rate,
            missing=missing,
        )
        chosen = wanted.choose({name: (name,) for name in rows.columns}, demo="demo", time="time")
        signals = {name: rows.get_column(name).to_numpy() for name in chosen.signals}
        return cls(**wanted.read_rows(chosen, signals))

    def to_frame(self, library: Any = "pandas") -> Any:
        """Table with columns demo, time and the outputs, a row a sample.

        Parameters
        ----------
        library : {"pandas", "polars", "pyarrow"} or module, default="pandas"
            It must be installed.
        """
        import narwhals

        taken = {"demo", "time"} & set(self.names)
        if taken:
            raise InvalidParameterError(
                f"an output named {min(taken)!r} cannot be told from the other columns: rename it."
            )
        columns = {
            "demo": np.repeat(np.arange(len(self.times)), [len(time) for time in self.times]),
            "time": np.concatenate(self.times),
            **dict(zip(self.names, np.concatenate(self.positions).T, strict=True)),
        }
        return narwhals.from_dict(columns, backend=library).to_native()

    @classmethod
    def concatenate(cls, parts: Iterable[Self]) -> Self:
        """All demonstrations of several sets, one after another; outputs, units, frame and unit of time must agree."""
        sets = [checks.instance(part, f"parts[{i}]", cls) for i, part in enumerate(parts)]
        if not sets:
            raise InvalidParameterError("parts is empty, must have at least one set of demonstrations.")
        for i, part in enumerate(sets):
            for label in ("names", "units", "frame", "time_unit"):
                mine, first = getattr(part, label), getattr(sets[0], label)
                if mine != first:
                    raise InvalidParameterError(
                        f"parts[{i}] has {label} {mine}, must be as parts[0], {first}: use .select() or .in_units()."
                    )
        times, positions = ([a for part in sets for a in getattr(part, name)] for name in ("times", "positions"))
        alignment = sets[0].alignment if len({part.alignment for part in sets}) == 1 else None
        suspects = find_suspects(positions, sets[0].names, sets[0].units)
        return sets[0]._replace(times, positions, alignment=alignment, suspects=suspects)

    def select(self, outputs: str | Sequence[str]) -> Self:
        """These demonstrations with some of the outputs, in the order given."""
        chosen = as_texts(outputs, "outputs")
        absent = [name for name in chosen if name not in self.names]
        if absent or not chosen or len(set(chosen)) < len(chosen):
            raise checks.refusal([*chosen], "outputs", f"different ones of {preview(self.names)}")
        kept = [self.names.index(name) for name in chosen]
        positions = [position[:, kept] for position in self.positions]
        units = self.units and tuple(self.units[i] for i in kept)
        suspects = find_suspects(positions, chosen, units)
        return self._replace(self.times, positions, names=chosen, units=units, suspects=suspects)

    def in_units(self, unit: str | None = None, time_unit: str | None = None) -> Self:
        """These demonstrations in another unit of length or angle, and of time.

        Parameters
        ----------
        unit : str, default=None
            A length or an angle, of the outputs that are such; outputs of other kinds stay as they are.
        time_unit : str, default=None
            h, min, s, ms, us or ns.

        Raises
        ------
        ValueError
            If the units are not known, or none is of that kind.
        """
        times, positions, units = self.times, self.positions, self.units
        if unit is not None:
            check_unit(unit, "unit", LENGTHS | ANGLES)
            kind = next((kind for kind in (LENGTHS, ANGLES) if unit in kind), {})
            if not set(units or ()) & set(kind):
                must = f"of the kind of one of the outputs, which are in {units or 'no known units (give units=)'}"
                raise checks.refusal(unit, "unit", must)
            own_units = [own if own in kind else unit for own in units or ()]
            positions = tuple(
                np.column_stack([_convert(y, own, unit, kind) for y, own in zip(position.T, own_units, strict=True)])
                for position in positions
            )
            units = tuple(unit if own in kind else own for own in units or ())
        if time_unit is not None:
            if time_unit not in TIMES or self.time_unit not in TIMES:
                raise checks.refusal(
                    time_unit,
                    "time_unit",
                    f"one of {', '.join(TIMES)}, as that of these demonstrations, {self.time_unit}",
                )
            times = tuple(_convert(time, self.time_unit, time_unit, TIMES) for time in times)
        return self._replace(times, positions, units=units, time_unit=time_unit or self.time_unit)

    def cut(self, at: Literal["pauses"] | Sequence[tuple[float, float]] = "pauses", *, pause: float = 0.5) -> Self:
        """One long recording as several demonstrations.

        Where a column of a file tells them apart, ``demo=`` of `torch_pbd.data.load_demonstrations` does it.

        Parameters
        ----------
        at : "pauses" or sequence of (start, end), default="pauses"
            Times of each demonstration, in ``time_unit``; "pauses" takes what lies between them.
        pause : float, default=0.5
            Shortest pause, in ``time_unit``: for so long, all outputs stay within 2 % of their extent.
        """
        if len(self.times) != 1:
            raise InvalidParameterError(
                f"there are {len(self.times)} recordings, must be one to be cut: take one, as [:1]."
            )
        time, position = self.times[0], self.positions[0]
        if isinstance(at, str):
            checks.choice(at, "at", ("pauses",))
            moving = ~still(time, position, checks.number(pause, "pause", above=0.0))
            edges = np.flatnonzero(np.diff(np.r_[False, moving, False]))
            spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= MIN_SAMPLES]
            if not spans:
                raise InvalidParameterError(
                    f"at is 'pauses', but nothing moves between pauses of {pause} {self.time_unit}."
                )
        else:
            spans = [_span(time, start_end, i) for i, start_end in enumerate(at)]
        return self._replace([time[a:b] for a, b in spans], [position[a:b] for a, b in spans], suspects=())

    def trim(self, method: Literal["still"] = "still", *, pause: float = 0.5) -> Self:
        """Each demonstration without what is still at its ends.

        ``pause`` is the shortest stretch of stillness that counts, in ``time_unit``, as in :meth:`cut`.
        """
        checks.choice(method, "method", ("still",))
        checks.number(pause, "pause", above=0.0)
        spans = []
        for time, position in zip(self.times, self.positions, strict=True):
            moving = np.flatnonzero(~still(time, position, pause))
            # One sample of stillness is kept at each end: it is where the movement starts and stops.
            spans.append(slice(max(moving[0] - 1, 0), moving[-1] + 2) if len(moving) else slice(None))
        times = [time[span] for time, span in zip(self.times, spans, strict=True)]
        return self._replace(times, [position[span] for position, span in zip(self.positions, spans, strict=True)])

    def from_start(self) -> Self:
        """These demonstrations with the times of each counted from its start.

        Grids that then differ by no more than their stamps resolve become one, as in ``stack("phase")``.
        """
        return self._replace(times_from_start(self.times), self.positions)

    def split(self, k: int | Sequence[int]) -> tuple[Self, Self]:
        """Leave demonstrations out: ``(train, test)``, where ``test`` has those numbered ``k``, and ``train`` some."""
        held_out = np.zeros(len(self.times), dtype=bool)
        try:
            held_out[np.asarray(k)] = True
        except IndexError as error:
            must = f"the number of a demonstration, or a list of them, numbered 0 to {len(self.times) - 1}"
            raise checks.refusal(k, "k", must) from error
        if held_out.all():
            raise InvalidParameterError(
                f"k leaves out {len(self.times)} of {len(self.times)} demonstrations: both parts need some."
            )
        return self[~held_out], self[held_out]

    def describe(self) -> "Description":
        """What is in the recordings, and what is likely wrong with them: tables to print, and ``mistakes``."""
        from torch_pbd.data.description import describe

        return describe(self)


def _span(time: Floats, start_end: Any, i: int) -> tuple[int, int]:
    ends = checks.real_floats(start_end, f"at[{i}]")
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise checks.refusal(start_end, f"at[{i}]", "a start and an end after it, in the unit of the times")
    a, b = np.searchsorted(time, ends[0]), np.searchsorted(time, ends[1], side="right")
    if b - a < MIN_SAMPLES:
        raise InvalidParameterError(
            f"at[{i}] holds {b - a} samples between {ends[0]:g} and {ends[1]:g}, must hold {MIN_SAMPLES}: the "
            f"recording goes from {time[0]:g} to {time[-1]:g}."
        )
    return int(a), int(b)


def _convert(values: Floats, unit: str, other: str, known: dict[str, float]) -> Floats:
    """Values in another unit of the kind; whole numbers are divided by, as 1000 is exact and 0.001 is not."""
    here, there = known[unit], known[other]
    return values * (here / there) if here >= there else values / (there / here)
