"""Options of reading, whatever the format: columns by their names, times, units; the one way out of files."""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.recordings import Fresh, Missing, as_texts, preview
from torch_pbd.data.units import TIMES
from torch_pbd.files.memory import require_memory

_FEWEST_COUNTED = 5  # rows; fewer rise by one by chance
MAX_BYTES = 512 * 2**20
_UNNAMED = ("", "__index_level_0__")  # what pandas calls the index of a table in files
_DATE_UNITS = {"h": "h", "min": "m", "s": "s", "ms": "ms", "us": "us", "ns": "ns"}
Arguments = dict[str, Any]


class Chosen(NamedTuple):
    """Columns to read, each as the name of its signal and its place in it; None where there is none."""

    demo: str | None
    time: tuple[str, int] | None
    outputs: list[tuple[str, int]]
    names: list[str]

    @property
    def signals(self) -> list[str]:
        """Signals to read, each once."""
        places = [*([(self.demo, 0)] if self.demo is not None else []), *([self.time] if self.time else [])]
        return list(dict.fromkeys(signal for signal, _ in (*places, *self.outputs)))


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The options that all formats have, as `torch_pbd.data.load_demonstrations` describes them."""

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
    notes: list[str] | None = None
    """If a list, it is told what would be refused and has a way around."""

    def __post_init__(self) -> None:
        checks.text(self.demo, "demo", optional=True)
        checks.text(self.time, "time", optional=True)
        checks.number(self.rate, "rate", above=0.0, unit="Hz", optional=True)
        checks.choice(self.missing, "missing", Missing)
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
        """Columns wanted of ``signals``, which give the names of the columns of each.

        A signal of several columns may be named for all of them. ``demo``, ``time`` and ``outputs`` are the signals
        that the format means by default; an absent one is no fault but of the time, where no ``rate`` is given.
        """
        places = {column: (signal, i) for signal, columns in signals.items() for i, column in enumerate(columns)}
        demo = demo if self.demo is None and demo in places else self.demo
        time = self.time or time
        if self.rate is not None:
            time = time if time in places else None
        elif time is not None and time not in places:
            time = self._likely_time(time, places)
        taken = [name for name in (demo, time) if name is not None]
        _require_columns(taken, places)
        names = self._output_names(signals, places, taken, outputs)
        _require_columns(names, places, "no column of outputs")
        moment = None if time is None or self.rate is not None else places[time]
        return Chosen(demo, moment, [places[name] for name in names], names)

    def _output_names(
        self, signals: Mapping[str, Sequence[str]], places: Mapping[str, Any], taken: Sequence[str], default: str | None
    ) -> list[str]:
        wanted = self.outputs if self.outputs is not None or default not in signals else [str(default)]
        if wanted is not None:
            names = [column for name in wanted for column in ([name] if name in places else signals.get(name, [name]))]
            return [*names, *(name for name in self.rotation or () if name not in names)]
        names = [name for name in places if name not in (*taken, *_UNNAMED)]
        for place, name in enumerate(places):
            if name in _UNNAMED and name not in taken:
                self.refuse(
                    f"column {place + 1} has no name, as the index of a table that was written without index=False. "
                    f"Leave it out, or say by outputs= which of {preview(names)} are movements."
                )
        return names

    def _likely_time(self, time: str, places: Mapping[str, Any]) -> str:
        """The only column whose name is one of times."""
        likely = [name for name in places if re.search(r"(?i)time|stamp|^t$|^sec|^t_", name)]
        if len(likely) == 1:
            self.refuse(f"no column {time!r} among {preview([*places])}: say time={likely[0]!r}, if that is it.")
        return likely[0] if len(likely) == 1 else time

    def refuse(self, message: str) -> None:
        """Raise ValueError, or note the message where notes are taken and the caller knows a way around."""
        if self.notes is None:
            raise ValueError(message)
        self.notes.append(message)

    def require(self, n_bytes: float, what: str) -> None:
        """Refuse what unpacks to more than ``max_bytes`` or than the memory takes, before it is read."""
        if n_bytes > self.max_bytes:
            raise ValueError(f"{what} unpacks to {n_bytes:.0f} bytes, more than max_bytes={self.max_bytes}: raise it.")
        require_memory(3.0 * n_bytes, what=what, remedy="Name fewer outputs=, or split the file.")

    def arguments(
        self,
        times: Sequence[NDArray[Any]] | None,
        positions: Sequence[NDArray[Any]],
        names: Sequence[str],
        **labels: Any,
    ) -> Arguments:
        """Arguments of ``Demonstrations``, of each recording's arrays; ``labels`` are the file's, if none are given."""
        if self.outputs is None and positions:
            counts = check_movements(names, positions)
            for message in counts.values():
                self.refuse(message)
            kept = [i for i, name in enumerate(names) if name not in counts]
            if counts and kept:
                names, positions = [names[i] for i in kept], [position[:, kept] for position in positions]
                labels |= {"units": [labels["units"][i] for i in kept]} if isinstance(labels.get("units"), list) else {}
        unit = self.time_unit or labels.get("time_unit") or "s"
        if self.rate is not None:
            times, unit = [np.arange(len(position)) / self.rate for position in positions], "s"
        elif times is None:
            self.refuse("it holds no times: give rate=, the samples a second (robosuite records 20).")
            times, unit = [np.arange(len(position)) for position in positions], "samples"
        elif times and all(np.asarray(time).dtype.kind in "mM" for time in times):
            times = _numbers_of_dates(times, checks.choice(unit, "time_unit", _DATE_UNITS))
        given = {"units": self.units, "frame": self.frame, "rotation": self.rotation, "angles": self.angles}
        labels |= {name: value for name, value in given.items() if value is not None}
        labels |= {"names": names, "time_unit": unit, "missing": self.missing}
        return {"times": times, "positions": Fresh(positions), **labels}

    def read_each(self, chosen: Chosen, recordings: Iterable[Mapping[str, NDArray[Any]]], **labels: Any) -> Arguments:
        """:meth:`arguments` of the signals of each recording."""
        parts = [self._columns(chosen, signals) for signals in recordings]
        times = [time for time, _ in parts if time is not None] if chosen.time else None
        return self.arguments(times, [position for _, position in parts], chosen.names, **labels)

    def read_rows(self, chosen: Chosen, signals: Mapping[str, NDArray[Any]], **labels: Any) -> Arguments:
        """:meth:`arguments` of a long table, whose rows tell theirs; in the order of their first rows."""
        demo = np.zeros(len(signals[chosen.signals[0]]), bool) if chosen.demo is None else signals[chosen.demo]
        blank = [row for row in heads_of(demo) if demo[row] is None or demo[row] != demo[row]]
        if blank:
            raise ValueError(f"column {chosen.demo!r} is blank in row {blank[0]}: it tells the demonstrations apart.")
        each = ({name: values[own] for name, values in signals.items()} for own in rows_of(demo))
        return self.read_each(chosen, each, **labels)

    def finish(self, parts: Sequence[Any]) -> Any:
        """Demonstrations of all files as one set, converted, cut and trimmed."""
        for unit in self.in_units or ():
            parts = [part.in_units(**{"time_unit" if unit in TIMES else "unit": unit}) for part in parts]
        whole = parts[0] if len(parts) == 1 else type(parts[0]).concatenate(parts)
        if len(parts) > 1 and self.angles is not None:
            whole = whole.unwrap(self.angles)
        whole = whole if self.cut is None else whole.cut(self.cut)
        whole = whole if self.trim is None else whole.trim(self.trim)
        return whole.from_start() if self.from_start else whole

    def _columns(self, chosen: Chosen, signals: Mapping[str, NDArray[Any]]) -> tuple[NDArray[Any] | None, NDArray[Any]]:
        """Times (T,), where there are any, and positions (T, d) of one recording."""

        def column(place: tuple[str, int]) -> NDArray[Any]:
            values = signals[place[0]]
            return values if values.ndim == 1 else values[:, place[1]]

        outputs = [column(place) for place in chosen.outputs]
        position = np.empty((len(outputs[0]), len(outputs)))
        for i, (name, values) in enumerate(zip(chosen.names, outputs, strict=True)):
            if values.dtype.kind not in "biuf":
                raise ValueError(f"column {name!r} holds {values.dtype}, no numbers: leave it out by outputs=.")
            position[:, i] = values
        return column(chosen.time) if chosen.time else None, position


def _require_columns(names: Sequence[str], places: Mapping[str, Any], none: str = "") -> None:
    absent = [f"no column {name!r}" for name in names if name not in places] or ([] if names else [none])
    if any(absent):
        raise ValueError(
            f"{absent[0]} among {preview([*places])}. Name the columns by the options demo=, time= (or rate=, in Hz, "
            "where there are no times) and outputs=."
        )


OPTIONS = tuple(field.name for field in fields(Wanted) if field.name != "notes")
"""Names of the options that all formats have."""


def check_options(options: Iterable[str], known: Sequence[str], what: str) -> None:
    """Raise TypeError for options that ``what`` does not have."""
    for option in options:
        if option not in known:
            close = difflib.get_close_matches(option, known, n=1)
            meant = f"did you mean {close[0]!r}?" if close else f"they have: {', '.join(known)}."
            raise TypeError(f"{what} have no option {option!r}; {meant}")


def _numbers_of_dates(times: Sequence[NDArray[Any]], unit: str) -> list[Floats]:
    """Times since the first of all, which are exact where dates would not be."""
    step = np.array(1, dtype=f"m8[{_DATE_UNITS[unit]}]")
    origin = min((time.min() for time in times), default=None)
    return [(time - origin).astype("m8[ns]") / step for time in times]


def heads_of(labels: NDArray[Any]) -> NDArray[np.intp]:
    """Numbers of the rows that begin a run of equal ones."""
    return np.flatnonzero(np.r_[True, labels[1:] != labels[:-1]][: len(labels)])


def rows_of(demo: NDArray[Any]) -> Sequence[slice | NDArray[np.intp]]:
    """Rows of each demonstration, in the order of their first ones."""
    heads = heads_of(demo)
    _, first, inverse = np.unique(demo[heads], return_index=True, return_inverse=True)
    # Most tables have one run of rows for each, which take no copies; else runs are sorted, not rows.
    if len(first) == len(heads):
        return [slice(a, b) for a, b in pairwise([*heads.tolist(), len(demo)])]
    rank = np.repeat(np.argsort(np.argsort(first))[inverse], np.diff(np.r_[heads, len(demo)]))
    return np.split(np.argsort(rank, kind="stable"), np.cumsum(np.bincount(rank))[:-1])


def check_movements(names: Sequence[str], positions: Sequence[Floats]) -> dict[str, str]:
    """Sentences on the columns that count rows or number demonstrations, which nobody named as outputs."""
    found = {}
    for i, name in enumerate(names):
        values = np.concatenate([position[:, i] for position in positions])
        if len(values) < _FEWEST_COUNTED or not (values == np.round(values)).all():
            continue
        step = np.concatenate([np.diff(position[:, i]) for position in positions])
        # A count of all rows is so too where rows of several demonstrations are mixed.
        counts = (step == 1.0).all() or ((step > 0.0).all() and (np.diff(np.sort(values)) == 1.0).all())
        rises = np.flatnonzero(step)
        # A number of the trial stays for a while, and then is the next one; a gripper that closes goes from 0 to 1.
        numbers = (name.endswith(("_index", "_id")) and not len(rises)) or (
            2 <= len(rises) <= len(step) / _FEWEST_COUNTED and (step[rises] == 1.0).all()
        )
        if counts or numbers:
            found[name] = "counts rows" if counts else "numbers demonstrations"
    kept = [name for name in names if name not in found]
    return {
        name: f"column {name!r}: it {what}, and is no movement. Leave it out, or say which columns are: outputs={kept}"
        + (f", and demo={name!r} if it tells the demonstrations apart." if what.startswith("numbers") else ".")
        for name, what in found.items()
    }


def natural(name: str) -> list[tuple[int, str]]:
    """Key that sorts demo_10 after demo_9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def column_names(signal: str, n: int) -> tuple[str, ...]:
    """Names of the columns of a signal that has none for them; those of positions are x, y, z."""
    is_position = signal.endswith(("pos", "position")) and n in (2, 3)
    return (signal,) if n == 1 else tuple(f"{signal}_{'xyz'[i] if is_position else i}" for i in range(n))
