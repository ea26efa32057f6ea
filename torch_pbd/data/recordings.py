"""Checks of recordings before they become ``Demonstrations``: finite samples, increasing times, labels."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.units import ANGLES, LENGTHS, check_unit, exact, nanoseconds_hint
from torch_pbd.exceptions import InvalidParameterError, MissingDataWarning

Missing = Literal["raise", "drop"]
MIN_SAMPLES = 2
# Times further apart would have infinite durations, and phases of NaN. Quarters have finite differences.
_LONGEST = 0.25 * float(np.finfo(np.float64).max)
_ALONE = "One demonstration alone is written [positions]."
Arrays = list[NDArray[Any]]


def as_recordings(times: Any, positions: Any, missing: str) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
    """Read-only float64 copies of K times (T_k,) and positions (T_k, d), without missing samples if these are dropped.

    Messages use the original sample indices.
    """
    drop = checks.choice(missing, "missing", Missing) == "drop"
    samples = [_samples(entry, f"positions[{k}]", drop) for k, entry in enumerate(_as_list(positions, "positions"))]
    stamps = _as_list(times, "times")
    # Times are one array for all if the first entry is a number, and not an array of its own.
    if _numbers(stamps[0], "times[0]", drop).ndim == 0:
        names, grids = ["times"] * len(samples), [_numbers(times, "times", drop)] * len(samples)
    else:
        names = [f"times[{k}]" for k in range(len(stamps))]
        grids = [_numbers(time, name, drop) for time, name in zip(stamps, names, strict=True)]
    if len(grids) != len(samples):
        must = f"{len(grids)} arrays but positions has {len(samples)} demonstrations"
        raise InvalidParameterError(f"times has {must}: give one for each, or a 1-D one for all.")
    for k, (grid, sample) in enumerate(zip(grids, samples, strict=True)):
        if grid.ndim != 1:
            raise InvalidParameterError(f"{names[k]} has shape {grid.shape}, must be 1-D: one time for each sample.")
        if len(grid) < MIN_SAMPLES:
            has = f"{names[k]} has {len(grid)} samples"
            raise InvalidParameterError(f"{has}: a demonstration needs at least {MIN_SAMPLES}.")
        if len(grid) != len(sample):
            raise InvalidParameterError(
                f"{names[k]} has {len(grid)} samples but positions[{k}] has {len(sample)}, of lengths "
                f"{preview(list(map(len, samples)))}: give each demonstration its own times. {_ALONE}"
            )
        n, first = sample.shape[1], samples[0].shape[1]
        if n != first:
            raise InvalidParameterError(f"positions[{k}] has {n} outputs but positions[0] has {first}: select some.")
    kept = [np.arange(len(grid)) for grid in grids]
    if drop:
        kept = _not_missing(grids, samples)
        grids = [grid[numbers] for grid, numbers in zip(grids, kept, strict=True)]
        samples = [sample[numbers] for sample, numbers in zip(samples, kept, strict=True)]
    return tuple(map(_rising, from_common_origin(grids), grids, names, kept)), tuple(map(frozen, samples))


def as_texts(values: Any, name: str, n_outputs: int | None = None) -> tuple[str, ...]:
    """Several texts or one; one per output if their number is given."""
    if not isinstance(values, str | list | tuple | np.ndarray):
        raise checks.refusal(values, name, "strings")
    entries = (values,) if isinstance(values, str) else values
    texts = tuple(checks.text(entry, f"{name}[{i}]") for i, entry in enumerate(entries))
    if n_outputs is not None and len(texts) != n_outputs:
        has = f"{name} has {len(texts)} entries {preview(texts)}"
        raise InvalidParameterError(f"{has} but the demonstrations have {n_outputs} outputs: give one for each.")
    return texts


def as_names(names: Any, n_outputs: int) -> tuple[str, ...]:
    """Distinct names of the outputs; y0, y1, ... by default."""
    values = as_texts([f"y{i}" for i in range(n_outputs)] if names is None else names, "names", n_outputs)
    if len(set(values)) < n_outputs:
        raise InvalidParameterError(f"names must differ from each other; got {preview(values)}.")
    return values


def as_units(units: Any, n_outputs: int) -> tuple[str, ...] | None:
    """Unit of each output, or None; one string is the unit of all."""
    if units is None:
        return None
    one = isinstance(units, str)
    values = (units,) * n_outputs if one else as_texts(units, "units", n_outputs)
    for i, unit in enumerate(values):
        check_unit(unit, "units" if one else f"units[{i}]", LENGTHS | ANGLES)
    return values


def preview(values: Sequence[object], limit: int = 12) -> str:
    """Text of the values, truncated where it is long."""
    shown = ", ".join(str(value) for value in values[:limit])
    return f"[{shown}, ... {len(values)} in all]" if len(values) > limit else f"[{shown}]"


def frozen(array: NDArray[Any]) -> Floats:
    """Read-only float64 array over bytes, which nobody can write to: a copy, but for one that is such already."""
    if isinstance(array.base, bytes) and array.dtype == np.float64 and array.flags.c_contiguous:
        return array
    return np.ndarray(array.shape, np.float64, np.asarray(array, dtype=np.float64).tobytes())


def _as_list(values: Any, name: str) -> list[Any]:
    try:
        entries = list(values)
    except TypeError as error:
        raise checks.refusal(values, name, "a list of one array for each demonstration, or one array") from error
    if not entries:
        raise InvalidParameterError(f"{name} is empty, must have at least one demonstration.")
    return entries


def _numbers(values: Any, name: str, drop: bool) -> NDArray[Any]:
    """Finite numbers, with ``drop`` also NaN, in their own type, since float64 rounds integers beyond 2**53."""
    if drop and np.ma.is_masked(values):
        values = np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)
    array = checks.real_array(values, name)
    array = array if array.dtype.kind in "fiu" else checks.real_floats(array, name)
    checks.require(~np.isinf(array), array, name, "finite")
    checks.require(drop | ~np.isnan(array), array, name, "finite", "missing='drop' leaves such samples out")
    return array


def _samples(values: Any, name: str, drop: bool) -> NDArray[Any]:
    array = _numbers(values, name, drop)
    samples = array[:, np.newaxis] if array.ndim == 1 else array
    if samples.ndim != 2 or samples.shape[1] == 0:
        must = "(n_samples, n_outputs), or (n_samples,) for one output"
        raise InvalidParameterError(f"{name} has shape {array.shape}, must be {must}. {_ALONE}")
    return samples


def _not_missing(grids: Arrays, samples: Arrays) -> list[NDArray[np.intp]]:
    """Indices of the samples without NaN in time and position; warns of the number of others."""
    holes = [np.isnan(grid) | np.isnan(sample).any(1) for grid, sample in zip(grids, samples, strict=True)]
    lost = {k: (int(hole.sum()), len(hole)) for k, hole in enumerate(holes) if hole.any()}
    for k, (n_lost, n) in lost.items():
        if n - n_lost < MIN_SAMPLES:
            left = f"positions[{k}] has {n - n_lost} of {n} samples left without missing values"
            raise InvalidParameterError(f"{left}, must be at least {MIN_SAMPLES}: leave it out, or fill them in.")
    if lost:
        counts = preview([f"{n_lost} of {n} in demonstration {k}" for k, (n_lost, n) in lost.items()])
        # A run begins where the padded mask turns true and ends where it turns false: edges alternate.
        edges = [np.flatnonzero(np.diff(np.r_[False, hole, False])) for hole in holes]
        longest = max(int((edge[1::2] - edge[::2]).max(initial=0)) for edge in edges)
        checks.warn(
            f"Dropped {sum(map(np.sum, holes))} of {sum(map(len, holes))} samples that have missing values: "
            f"{counts[1:-1]}. At most {longest} of them follow each other; what interpolates later draws straight "
            "lines there.",
            MissingDataWarning,
        )
    return [np.flatnonzero(~hole) for hole in holes]


def from_common_origin(grids: Arrays) -> Arrays:
    """Times; integers too large for float64 are counted from the first one, so that steps stay exact."""
    whole = [grid for grid in grids if grid.dtype.kind in "iu" and grid.size]
    beyond = [grid for grid in whole if max(grid.max(), -int(grid.min())) > 2**53]
    if not beyond:
        return grids
    origin = min(int(grid.min()) for grid in beyond)
    # As Python's integers, whose differences, over all of int64 or of uint64, do not overflow.
    return [np.float64(grid.astype(object) - origin) if grid.dtype.kind in "iu" else grid - origin for grid in grids]


def _rising(grid: NDArray[Any], original: NDArray[Any], name: str, numbers: NDArray[np.intp]) -> Floats:
    """Checked strictly increasing times; messages show them as in ``original``."""
    time = frozen(grid)
    if np.ptp(0.25 * time) > _LONGEST:
        far = f"{name} goes from {time.min():.3g} to {time.max():.3g}"
        raise InvalidParameterError(f"{far}, further than float64 can tell: take another unit of time.")
    coarse = ""
    if original.dtype.kind == "f" and original.dtype.itemsize < 8:  # such as Unix time in float32
        resolution, step = float(np.spacing(np.abs(original).max())), (time[-1] - time[0]) / (len(time) - 1)
        # A resolution of a quarter of a step changes a derivative by as much; finer errors are left to smoothing.
        if resolution > 0.25 * step:
            coarse = f" It is {original.dtype}, which resolves {resolution:.3g} at {time[-1]:.6g}, where the mean step "
            coarse += f"is {step:.3g}: record times as float64, or count them from the start."
    falls = np.flatnonzero(np.diff(time) <= 0)
    if len(falls):
        i = int(falls[0]) + 1
        before, here = (exact(stamp) for stamp in original[i - 1 : i + 1].tolist())
        raise InvalidParameterError(
            f"{name} must increase strictly, but sample {numbers[i]} is at {here} after {before}. "
            f"Sort the samples by time and drop repeated ones.{coarse or nanoseconds_hint(original)}"
        )
    if coarse:
        raise InvalidParameterError(f"{name} is too coarse for its own steps.{coarse}")
    return time
