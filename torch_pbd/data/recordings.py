"""What a set of recordings must be before it becomes ``Demonstrations``."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.alignment import Floats
from torch_pbd.data.missing import drop_missing
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES, check_unit, exact, nanoseconds_hint
from torch_pbd.files.memory import require_much

MIN_SAMPLES = 2
_LONGEST = 0.25 * float(np.finfo(np.float64).max)  # quarters of times, whose difference is a number

# Of dates and durations, which .astype(float) makes numbers that are too coarse, of whatever unit.
_CONVERSION = {kind: f".astype('{kind}8[ns]').astype('int64') and time_unit='ns'" for kind in "Mm"}


def as_recordings(times: Any, positions: Any, missing: str) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """Read-only float64 copies: K times (T_k,) and K positions (T_k, d)."""
    check_choice(missing, ("raise", "drop"), "missing")
    drop = missing == "drop"
    recordings = [_position_array(p, k, drop) for k, p in enumerate(_as_list(positions, "positions"))]
    stamps = _as_list(times, "times")
    shared = _as_numbers(stamps[0], "times[0]", drop).ndim == 0
    if shared:
        grids = [_time_array(times, "times", drop)]
        _check_shared_length(len(grids[0]), recordings)
    elif len(stamps) != len(recordings):
        raise ValueError(
            f"times has {len(stamps)} arrays but positions has {len(recordings)} demonstrations: give one "
            "time array for each demonstration, or one 1-D array that all of them share."
        )
    else:
        grids = [_time_array(time, f"times[{k}]", drop) for k, time in enumerate(stamps)]
    _check_consistent(grids * len(recordings) if shared else grids, recordings)
    kept: Sequence[NDArray[np.intp]] = [np.arange(len(position)) for position in recordings]
    if drop:
        grids, shared = grids * len(recordings) if shared else grids, False
        grids, recordings, kept = drop_missing(grids, recordings, MIN_SAMPLES)
    counted, argument = _from_common_origin(grids), "times" if shared else "times[{}]"
    frozen = [_as_time(t, grids[k], argument.format(k), kept[k]) for k, t in enumerate(counted)]
    times_ = frozen * len(recordings) if shared else frozen
    return tuple(times_), tuple(_as_position(p, k, kept[k]) for k, p in enumerate(recordings))


def as_labels(labels: str | Sequence[str], n_outputs: int, argument: str) -> tuple[str, ...]:
    """One string for each output."""
    if not isinstance(labels, str | list | tuple | np.ndarray) or (not np.ndim(labels) and not isinstance(labels, str)):
        raise ValueError(f"{argument} is {labels!r}, must be strings: one for each output.")
    values = (labels,) if isinstance(labels, str) else tuple(labels)
    if not all(isinstance(value, str) for value in values):
        raise ValueError(f"{argument} must be strings, one for each output; got {values}.")
    if len(values) != n_outputs:
        raise ValueError(
            f"{argument} has {len(values)} entries {preview(values)} but the demonstrations have {n_outputs} "
            "outputs: give one for each output."
        )
    return values


def as_units(units: str | Sequence[str] | None, n_outputs: int) -> tuple[str, ...] | None:
    """A unit for each output, or None; one string is that of all."""
    if units is None:
        return None
    values = as_labels((units,) * n_outputs if isinstance(units, str) else units, n_outputs, "units")
    for i, unit in enumerate(values):
        check_unit(unit, "units" if isinstance(units, str) else f"units[{i}]", LENGTHS | ANGLES)
    return values


def as_names(names: Sequence[str], n_outputs: int) -> tuple[str, ...]:
    """A name for each output, all different, that any file can hold."""
    values = as_labels(names, n_outputs, "names")
    if len(set(values)) < n_outputs:
        raise ValueError(f"names must differ from each other; got {preview(values)}.")
    for i, name in enumerate(values):
        checks.text(name, f"names[{i}]")
    return values


def check_frame_and_unit(frame: Any, time_unit: Any) -> None:
    """Name of a frame, or None, and a unit of times."""
    if not isinstance(frame, str | None):
        raise ValueError(f"frame is {frame!r}, must be text or None.")
    if not isinstance(time_unit, str) or not time_unit:
        raise ValueError(f"time_unit is {time_unit!r}, must be the unit of the times: 's', or '1' for phase.")
    check_unit(time_unit, "time_unit", TIMES)


def as_mask(k: int | Sequence[int], n_demos: int) -> NDArray[np.bool_]:
    """Which demonstrations are numbered ``k``: some, and not all of them."""
    mask = np.zeros(n_demos, dtype=bool)
    numbers = np.atleast_1d(np.asarray(k))
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu":
        raise ValueError(f"k must be the number of a demonstration or a list of numbers; got {k!r}.")
    wrong = numbers[(numbers < -n_demos) | (numbers >= n_demos)]
    if len(wrong):
        raise ValueError(f"k has {wrong[0]}, but demonstrations are numbered 0 to {n_demos - 1}.")
    mask[numbers] = True
    if mask.all() or not mask.any():
        raise ValueError(f"k leaves out {mask.sum()} of {n_demos} demonstrations: both parts need some.")
    return mask


def preview(values: Sequence[object], limit: int = 12) -> str:
    """The values as a list, cut where it gets long."""
    shown = ", ".join(str(value) for value in values[:limit])
    return f"[{shown}, ... {len(values)} in all]" if len(values) > limit else f"[{shown}]"


def check_choice(value: str, choices: Sequence[str], argument: str) -> None:
    """A string that must be one of a few."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{argument}={value!r} is not one of {', '.join(map(repr, choices))}.")


def check_n_steps(n: int) -> None:
    """A number of samples."""
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or not MIN_SAMPLES <= n < 2**53:
        raise ValueError(f"n={n!r} must be an integer of at least {MIN_SAMPLES}: the number of points.")
    require_much(64.0 * n, what=f"n={n} points", remedy="Lower it.")


def _as_list(values: Any, argument: str) -> list[Any]:
    try:
        entries = list(values)
    except TypeError as error:
        raise ValueError(
            f"{argument} must be a list with one array for each demonstration, or one array; got {values!r}."
        ) from error
    if not entries:
        raise ValueError(f"{argument} is empty: at least one demonstration is needed.")
    return entries


def _as_numbers(values: Any, argument: str, drop: bool) -> NDArray[Any]:
    if hasattr(values, "detach"):
        values = checks.from_tensor(values, argument)
    if np.ma.is_masked(values):
        if not drop:
            raise ValueError(
                f"{argument} has masked entries: drop these samples (missing='drop') or fill them in first."
            )
        values = np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{argument} is ragged, its rows have different lengths: {error}") from error
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{argument} has dtype {array.dtype}: real numbers are needed. Convert it, e.g. with "
            f"{_CONVERSION.get(array.dtype.kind, '.astype(float)')}, once it holds nothing else."
        )
    return array


def _frozen(array: NDArray[Any]) -> Floats:
    copy = np.array(array, dtype=np.float64, order="C")
    copy.setflags(write=False)
    return copy


def _position_array(values: Any, k: int, drop: bool) -> NDArray[Any]:
    array = _as_numbers(values, f"positions[{k}]", drop)
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.ndim != 2 or array.shape[1] == 0:
        raise ValueError(
            f"positions[{k}] has shape {np.shape(values)}: a demonstration is (n_samples, n_outputs), or "
            "(n_samples,) for one output. One demonstration alone is written [positions]."
        )
    return array


def _time_array(values: Any, argument: str, drop: bool) -> NDArray[Any]:
    array = _as_numbers(values, argument, drop)
    if array.ndim != 1:
        raise ValueError(f"{argument} has shape {array.shape}: times are 1-D, one for each sample.")
    if len(array) < MIN_SAMPLES:
        raise ValueError(f"{argument} has {len(array)} samples: a demonstration needs at least {MIN_SAMPLES}.")
    return array


def _as_position(array: NDArray[Any], k: int, numbers: NDArray[np.intp]) -> Floats:
    position = _frozen(array)
    if not np.isfinite(position).all():
        i, j = np.argwhere(~np.isfinite(position))[0]
        value = position[i, j]
        remedy = "Drop the missing samples (missing='drop') or fill them in" if np.isnan(value) else "Correct the value"
        raise ValueError(
            f"positions[{k}] is {value} at sample {numbers[i]}, output {j}: all values must be finite. {remedy} first."
        )
    return position


def _from_common_origin(grids: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Times; where whole numbers are beyond what float64 holds, from the first of them on, so that steps stay exact."""
    beyond = [grid for grid in grids if grid.dtype.kind in "iu" and max(grid.max(), -int(grid.min())) > 2**53]
    if not beyond:
        return grids
    origin = min(int(grid.min()) for grid in beyond)
    # As Python's integers: differences of the machine's may overflow.
    return [(grid.astype(object) if grid.dtype.kind in "iu" else grid) - origin for grid in grids]


def _as_time(array: NDArray[Any], original: NDArray[Any], argument: str, numbers: NDArray[np.intp]) -> Floats:
    time = _frozen(array)
    if not np.isfinite(time).all():
        i = int(np.argmin(np.isfinite(time)))
        raise ValueError(f"{argument} is {time[i]} at sample {numbers[i]}: all times must be finite.")
    if np.ptp(0.25 * time) > _LONGEST:
        raise ValueError(
            f"{argument} goes from {time.min():.3g} to {time.max():.3g}, further than float64 can tell: take another "
            "unit of time."
        )
    _check_rising(time, original, argument, numbers)
    return time


def _check_rising(time: Floats, original: NDArray[Any], argument: str, numbers: NDArray[np.intp]) -> None:
    coarse = _coarseness(original)
    falls = np.flatnonzero(np.diff(time) <= 0)
    if len(falls):
        i = int(falls[0]) + 1
        before, here = (exact(stamp) for stamp in original[i - 1 : i + 1].tolist())
        raise ValueError(
            f"{argument} must increase strictly, but sample {numbers[i]} is at {here} after {before}. "
            f"Sort the samples by time and drop repeated ones.{coarse or nanoseconds_hint(original)}"
        )
    if coarse:
        raise ValueError(f"{argument} is too coarse for its own steps.{coarse}")


def _coarseness(time: NDArray[Any]) -> str:
    """Why times of low precision (unix time in float32) are unusable; empty if they are not."""
    if time.dtype.kind != "f" or time.dtype.itemsize >= 8:
        return ""
    resolution = float(np.spacing(np.abs(time).max()))
    step = float(time[-1] - time[0]) / (len(time) - 1)
    if resolution <= 0.25 * step:
        return ""
    return (
        f" It is {time.dtype}, which resolves {resolution:.3g} at {float(time[-1]):.6g}, where the mean "
        f"step is {step:.3g}: record times as float64, or count them from the start of the demonstration."
    )


def _check_shared_length(n_samples: int, recordings: list[NDArray[Any]]) -> None:
    lengths = [len(position) for position in recordings]
    if any(length != n_samples for length in lengths):
        alone = " One demonstration alone is written [positions]." if len(recordings) == n_samples else ""
        raise ValueError(
            f"times is one array of {n_samples} samples for all demonstrations, but positions have lengths "
            f"{preview(lengths)}: give each demonstration its own times, then use .resample() or "
            f".align().{alone}"
        )


def _check_consistent(grids: list[NDArray[Any]], recordings: list[NDArray[Any]]) -> None:
    n_outputs = recordings[0].shape[1]
    for k, (time, position) in enumerate(zip(grids, recordings, strict=True)):
        if len(time) != len(position):
            raise ValueError(
                f"times[{k}] has {len(time)} samples but positions[{k}] has {len(position)}: each sample "
                "needs its time."
            )
        if position.shape[1] != n_outputs:
            raise ValueError(
                f"positions[{k}] has {position.shape[1]} outputs but positions[0] has {n_outputs}: all "
                "demonstrations must have the same outputs."
            )
