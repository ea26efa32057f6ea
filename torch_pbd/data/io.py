"""Demonstrations from files and to files: the doors; each format has its own module, named in one table."""

import inspect
import os
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations, Missing
from torch_pbd.exceptions import DataFormatError
from torch_pbd.files.atomic import LOADERS, replacing
from torch_pbd.files.memory import require_memory

MAX_BYTES = 512 * 2**20
# Bytes in memory for each of a file that is read; of a CSV 4.5 are measured, twice that with shorter numbers.
_COPIES = 10

# Each module has read(path, max_bytes, missing, **options), of which what it raises gets the path here, and
# write(demonstrations, handle). It is imported when a file of its kind is met, and what it needs from extras with it.
_FORMATS = {".npz": "torch_pbd.data.formats.npz", ".csv": "torch_pbd.data.formats.csv"}


def load_demonstrations(
    path: str | os.PathLike[str],
    *,
    max_bytes: int = MAX_BYTES,
    missing: Missing = "raise",
    from_start: bool = False,
    **options: Any,
) -> Demonstrations:
    """Demonstrations from a file, in the format that its suffix says.

    ``.npz``: either ``t`` (T,) and ``x`` (K, T, d), where all demonstrations share one grid of
    times, or ``t_0`` (T_0,), ``x_0`` (T_0, d), ``t_1``, ``x_1``, ...; and, if it is there, ``meta``, a 0-d
    string with a JSON object, of which ``dims`` (names of the outputs), ``units`` or ``unit``, ``time_unit``
    or ``t_unit`` and ``frame`` are read, and ``K`` and ``d`` checked. Other arrays are ignored. Pickled
    objects are never loaded.

    ``.csv``: a header, then one line a sample. Lines of different demonstrations may be mixed; each
    demonstration's own must be in order of time.

    Parameters
    ----------
    path : str or path-like
    max_bytes : int, default=512 MiB
        Larger files (.npz: unpacked) are refused before they are read.
    missing : {"raise", "drop"}, default="raise"
        "drop" leaves out samples with NaN (CSV: and blank cells), and warns of how many, as `Demonstrations` does.
    from_start : bool, default=False
        Count the times of each demonstration from its start: `Demonstrations.from_start`.
    units, time_unit
        As in `Demonstrations`; None takes those in the file, if it holds them.
    demo : str or None, default="demo"
        CSV: column that tells the demonstrations apart, by any text. None: the file is one demonstration.
    time : str, default="time"
        CSV: column of times.
    outputs : sequence of str, default=None
        CSV: columns of the outputs, in the order wanted; None takes all the others, if each has a name, and none is a
        count of rows (``frame_index``) or a number of its demonstration (``task_index``).
    delimiter : str, default=None
        CSV: None finds it among comma, semicolon and tab.
    decimal : {".", ","}, default="."
        CSV: decimal mark.
    frame
        CSV: as in `Demonstrations`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the suffix is not known, or an option is not as described.
    TypeError
        If an option is not one of the format's.
    DataFormatError
        If the file is not what its suffix says; names the array, or the line and the column. Or if it is too large
        for the memory.
    """
    checks.count(max_bytes, "max_bytes", remedy="the bytes of the largest file to read")
    file = Path(path)
    reader = _format(file).read
    known = list(inspect.signature(reader).parameters)[3:]
    unknown = [option for option in options if option not in known]
    if unknown:
        raise TypeError(f"{file.suffix} files have no option {unknown[0]!r}; they have: {', '.join(known) or 'none'}.")
    if not file.is_file():
        raise FileNotFoundError(f"{file} does not exist, or is not a file.")
    if file.stat().st_size > max_bytes:
        raise DataFormatError(
            f"{file} has {file.stat().st_size} bytes, more than max_bytes={max_bytes}: raise it to read this."
        )
    try:
        needed = _COPIES * file.stat().st_size
        require_memory(needed, what="reading it", remedy="Split the file, or leave samples out.")
        demonstrations: Demonstrations = reader(file, max_bytes, missing, **options)
    except (ValueError, TypeError) as error:
        raise DataFormatError(f"{file}: {error}") from error
    return demonstrations.from_start() if from_start else demonstrations


def save_demonstrations(demonstrations: Demonstrations, path: str | os.PathLike[str]) -> None:
    """Write demonstrations to ``path``, in the format that its suffix says (.npz or .csv).

    All numbers come back to the last bit. A CSV file does not hold units and frame, nor a checksum: one that somebody
    cuts or changes may be read as what it is not. An .npz file holds one of each array. The file appears complete or
    not at all, and replaces one that is there.

    Parameters
    ----------
    demonstrations : Demonstrations
    path : str or path-like
        Its folder must exist.

    Raises
    ------
    ValueError
        If the suffix is not known, or a name of an output cannot be a column of a CSV file.
    FileNotFoundError
        If the folder does not exist.
    """
    file = Path(path)
    write = _format(file).write
    with replacing(file) as handle:
        write(demonstrations, handle)


def _format(file: Path) -> ModuleType:
    suffix = file.suffix.lower()
    if suffix not in _FORMATS:
        raise ValueError(
            f"{file} has the suffix {file.suffix!r}; known formats of demonstrations: {', '.join(_FORMATS)}. {LOADERS}"
        )
    return import_module(_FORMATS[suffix])
