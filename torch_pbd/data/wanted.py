"""Reading options common to all formats: columns by name, times, units."""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.recordings import Missing, as_texts, from_common_origin, frozen, preview
from torch_pbd.data.units import TIMES
from torch_pbd.files.memory import require_memory

_FEWEST_COUNTED = 5  # fewest rows that identify a count; fewer increase by one by chance
MAX_BYTES = 512 * 2**20
UNNAMED = ("", "__index_level_0__")  # names of a table's index in files written by pandas
Arguments = dict[str, Any]
_Recorded = TypeVar("_Recorded", bound=Any)  # Demonstrations, whose import would be circular


class Chosen(NamedTuple):
    """Columns to read, each as the name of its signal and its place in it; None where there is none."""

    demo: tuple[str, int] | None
    time: tuple[str, int] | None
    outputs: list[tuple[str, int]]
    names: list[str]

    @property
    def signals(self) -> list[str]:
        """Signals to read, each once."""
        return list(dict.fromkeys(place[0] for place in (self.demo, self.time, *self.outputs) if place is not None))


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Options common to all formats, described in `torch_pbd.data.load_demonstrations`."""

    outputs: Sequence[str] | None = None
    demo: str | None = None
    time: str | None = None
    rotation: Sequence[str] | None = None
    angles: str | Sequence[str] | None = None
    rate: float | None = None
    units: str | Sequence[str] | None = None
    time_unit: str | None = None
    frame: str | None = None
    missing: Missing = "raise"
    in_units: str | Sequence[str] | None = None
    cut: Literal["pauses"] | Sequence[tuple[float, float]] | None = None
    trim: Literal["still"] | None = None
    from_start: bool = False
    max_bytes: int = MAX_BYTES
    notes: dict[str, str] | None = None
    """If a mapping, it takes what would be refused and has a way around, each with the option that mends it."""

    def __post_init__(self) -> None:
        checks.text(self.demo, "demo", optional=True)
        checks.text(self.time, "time", optional=True)
        checks.number(self.rate, "rate", above=0.0, unit="Hz", optional=True)
        checks.flag(self.from_start, "from_start")
        checks.count(self.max_bytes, "max_bytes", remedy="the bytes of the largest file to read")
        for name in ("outputs", "rotation", "in_units"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else as_texts(value, name))

    def choose(
        self,
        signals: Mapping[str, Sequence[str]],
        *,
        demo: str | None = None,
        time: str | None = None,
        outputs: str | None = None,
    ) -> Chosen:
        """Columns to read from ``signals``, which map each signal to the names of its columns.

        A signal of several columns may be named for all of them. ``demo``, ``time`` and ``outputs`` are the signals
        that the format means by default; an absent one is no fault but of the time, where no ``rate`` is given.
        """
        places: dict[Any, tuple[str, int]] = {
            column: (signal, i) for signal, columns in signals.items() for i, column in enumerate(columns)
        }
        demo = demo if self.demo is None and demo in places else self.demo
        time = self.time or time
        likely = [name for name in places if re.search(r"(?i)time|stamp|^t$|^sec|^t_", name)]
        if time not in places and self.rate is not None:
            time = None
        elif time is not None and time not in places and len(likely) == 1:
            what = f"no column {time!r} among {preview([*places])}"
            self.refuse(f"{what}: say time={likely[0]!r}, if that is it.", "time")
            time = likely[0]
        taken = [name for name in (demo, time) if name is not None]
        named = self.outputs if self.outputs is not None or outputs not in signals else [str(outputs)]
        if named is not None:
            names = [column for name in named for column in ([name] if name in places else signals.get(name, [name]))]
            names += [name for name in self.rotation or () if name not in names]
        else:
            names = [name for name in places if name not in (*taken, *UNNAMED)]
            for place in [i for i, name in enumerate(places) if name in UNNAMED and name not in taken]:
                index = f"column {place + 1} has no name, as the index of a table written without index=False"
                remedy = f"leave it out, or say by outputs= which of {preview(names)} are movements"
                self.refuse(f"{index}: {remedy}.", "outputs")
        absent = [repr(name) for name in (*taken, *names) if name not in places] or ["of outputs"] * (not names)
        if absent:
            options = {repr(demo): "demo=", repr(time): "time= (or rate=, in Hz, where there are none)"}
            remedy = f"name the one meant by {options.get(absent[0], 'outputs=')}"
            raise ValueError(f"no column {absent[0]} among {preview([*places])}: {remedy}.")
        time = None if self.rate is not None else time
        return Chosen(places.get(demo), places.get(time), [places[name] for name in names], names)

    def refuse(self, message: str, option: str) -> None:
        """Raise ValueError, or note the message where notes are taken and the caller knows a way around."""
        if self.notes is None:
            raise ValueError(message)
        self.notes[message] = option

    def require(self, n_bytes: float, what: str) -> None:
        """Raise before reading if data unpack to more than ``max_bytes`` or than fits in memory."""
        if n_bytes > self.max_bytes:
            raise ValueError(f"{what} unpacks to {n_bytes:.0f} bytes, more than max_bytes={self.max_bytes}: raise it.")
        require_memory(3.0 * n_bytes, what=what, remedy="Name fewer outputs=, or split the file.")

    def read_rows(self, chosen: Chosen, signals: Mapping[str, NDArray[Any]], **labels: Any) -> Arguments:
        """Arguments as from :meth:`read_each` for a long table, with demonstrations in order of their first rows."""
        n_rows = len(signals[chosen.signals[0]])
        demo = np.zeros(n_rows, bool) if chosen.demo is None else _column(signals, chosen.demo)
        if chosen.demo and demo.dtype == object and any(label.__hash__ is None for label in demo):
            raise ValueError(f"column {chosen.demo[0]!r} holds lists or alike, must be texts or numbers: convert it.")
        heads = np.flatnonzero(np.r_[True, demo[1:] != demo[:-1]][:n_rows])
        blank = [row for row in heads if demo[row] is None or demo[row] != demo[row]]
        if chosen.demo and blank:
            raise ValueError(
                f"column {chosen.demo[0]!r} is blank in row {blank[0]}: it tells the demonstrations apart."
            )
        each = ({name: values[own] for name, values in signals.items()} for own in _rows_of(demo, heads))
        return self.read_each(chosen, each, **labels)

    def read_each(self, chosen: Chosen, recordings: Iterable[Mapping[str, NDArray[Any]]], **labels: Any) -> Arguments:
        """Arguments of ``Demonstrations`` from the signals of each recording; ``labels`` are those in the file."""
        times, positions, widths = [], [], dict[str, int]()
        for k, signals in enumerate(recordings):
            for name in chosen.signals:
                n = (*signals[name].shape, 1)[1] if name in signals else 0
                if n != widths.setdefault(name, n):
                    must = f"must have {widths[name]} as that of the first: select others by outputs=, or mend the file"
                    raise ValueError(f"array {name!r} of demonstration {k} has {n} columns, {must}.")
            columns = [_numbers(signals, *one) for one in zip(chosen.outputs, chosen.names, strict=True)]
            positions.append(frozen(np.stack(columns, axis=1)))
            times.append(_column(signals, chosen.time) if chosen.time else np.arange(len(columns[0])))
            if hasattr(stamp := next(iter(times[-1]), None), "isoformat"):  # one of Python's
                raise checks.refusal(stamp, "time", "a datetime64 or a number", "convert the column")
        given = {name: getattr(self, name) for name in ("units", "frame", "rotation", "angles", "time_unit")}
        known = {name: value for name, value in (*labels.items(), *given.items()) if value is not None}
        labels = {"names": chosen.names, "time_unit": "s", **known}
        if self.outputs is None:
            positions, labels = self._without_counts(positions, labels)
        if self.rate is not None:
            times, labels["time_unit"] = [time / self.rate for time in times], "s"
        elif chosen.time is None:
            self.refuse("it holds no times: give rate=, the samples a second (robosuite records 20).", "rate")
            labels["time_unit"] = "samples"
        return {"times": times, "positions": positions, "missing": self.missing, **labels}

    def since_first(self, parts: Sequence[Arguments]) -> list[Arguments]:
        """Arguments with dates, and whole numbers beyond 2**53, counted from the first of all, which is exact."""
        grids: list[Any] = [time for part in parts for time in part["times"]]
        kinds = {time.dtype.kind for time in grids}
        if kinds and kinds <= {"m", "M"}:
            unit = checks.choice(self.time_unit or "s", "time_unit", TIMES).replace("min", "m")  # as NumPy has it
            origin, step = np.fmin.reduce([np.fmin.reduce(time) for time in grids]), np.array(1, dtype=f"m8[{unit}]")
            grids = [(time - origin).astype("m8[ns]") / step for time in grids]
        elif kinds <= {"i", "u", "f"} and len(parts) > 1:  # of one, errors tell the stamps
            grids = from_common_origin(grids)
        return [part | {"times": [grids.pop(0) for _ in part["times"]]} for part in parts]

    def finish(self, parts: Sequence[_Recorded]) -> _Recorded:
        """Demonstrations of all files as one set, converted, cut and trimmed."""
        parts = [part.in_units(self.in_units) for part in parts] if self.in_units else parts
        whole = parts[0] if len(parts) == 1 else type(parts[0]).concatenate(parts)
        if len(parts) > 1 and self.angles is not None:
            whole = whole.unwrap(self.angles)
        whole = whole if self.cut is None else whole.cut(self.cut)
        whole = whole if self.trim is None else whole.trim(self.trim)
        return whole.from_start() if self.from_start else whole

    def _without_counts(self, positions: list[Floats], labels: Arguments) -> tuple[list[Floats], Arguments]:
        """Columns without those that count rows or number demonstrations, unless named as outputs."""
        names = labels["names"]
        found = {}
        for i, name in enumerate(names if positions else ()):
            values = np.concatenate([position[:, i] for position in positions])
            if len(values) < _FEWEST_COUNTED or not (values == np.round(values)).all():
                continue
            step = np.concatenate([np.diff(position[:, i]) for position in positions])
            rises = np.flatnonzero(step)
            # A number of the trial stays for a while, and then is the next one; a gripper that closes goes from 0 to 1.
            if (name.endswith(("_index", "_id")) and not len(rises)) or (
                2 <= len(rises) <= len(step) / _FEWEST_COUNTED and (step[rises] == 1.0).all()
            ):
                found[name] = "numbers demonstrations"
            # A count of all rows is so too where rows of several demonstrations are mixed.
            if (step == 1.0).all() or ((step > 0.0).all() and (np.diff(np.sort(values)) == 1.0).all()):
                found[name] = "counts rows"
        kept = [i for i, name in enumerate(names) if name not in found]
        for name, what in found.items():
            apart = f", and demo={name!r} if it tells the demonstrations apart" if what.startswith("numbers") else ""
            others = [names[i] for i in kept] or [own for own in found if found[own] == "counts rows"] or [name]
            what = f"column {name!r}: it {what}, and is no movement"
            self.refuse(f"{what}: leave it out, or say outputs={others}{apart}.", "outputs")
        if not found or not kept:
            return positions, labels
        each = {key: [labels[key][i] for i in kept] for key in ("names", "units") if isinstance(labels.get(key), list)}
        return [position[:, kept] for position in positions], labels | each


OPTIONS = tuple(field.name for field in fields(Wanted) if field.name != "notes")
"""Names of the options that all formats have."""


def check_options(options: Iterable[str], known: Sequence[str], what: str) -> None:
    """Raise TypeError for options that ``what`` does not have."""
    for option in options:
        if option not in known:
            close = difflib.get_close_matches(option, known, n=1)
            meant = f"did you mean {close[0]!r}?" if close else f"they have: {', '.join(known)}."
            raise TypeError(f"{what} have no option {option!r}; {meant}")


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key that places demo_10 after demo_9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def numeric(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Numeric arrays (T,) or (T, d) of a file."""
    return {name: a for name, a in arrays.items() if a.dtype.kind in "biuf" and 1 <= a.ndim <= 2}


def column_names(signal: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Default names of the columns of a signal (T,) or (T, d); positions have x, y, z."""
    n = (*shape, 1)[1]
    is_position = signal.endswith(("pos", "position")) and n in (2, 3)
    return (signal,) if n == 1 else tuple(f"{signal}_{'xyz'[i] if is_position else i}" for i in range(n))


def _column(signals: Mapping[str, NDArray[Any]], place: tuple[str, int]) -> NDArray[Any]:
    values = signals[place[0]]
    return values if values.ndim == 1 else values[:, place[1]]


def _numbers(signals: Mapping[str, NDArray[Any]], place: tuple[str, int], name: str) -> NDArray[Any]:
    """Column of numbers; of objects that are numbers their floats, NaN where they are missing."""
    values = _column(signals, place)
    try:
        return values if values.dtype.kind in "biuf" else checks.real_floats(values, name)
    except (TypeError, ValueError) as error:
        raise ValueError(f"column {name!r} holds {values.dtype}, no numbers: leave it out by outputs=.") from error


def _rows_of(demo: NDArray[Any], heads: NDArray[np.intp]) -> Sequence[slice | NDArray[np.intp]]:
    """Rows of each demonstration, in the order of their first ones; ``heads`` are the rows that begin a run."""
    ranks: dict[Any, int] = {}  # of labels of any kind, which need not compare
    each = [ranks.setdefault(label, len(ranks)) for label in demo[heads].tolist()]
    # Most tables have one run of rows for each, which take no copies; else runs are sorted, not rows.
    if len(ranks) == len(heads):
        return [slice(a, b) for a, b in pairwise([*heads.tolist(), len(demo)])]
    rank = np.repeat(each, np.diff(np.r_[heads, len(demo)]))
    return np.split(np.argsort(rank, kind="stable"), np.cumsum(np.bincount(rank))[:-1])
