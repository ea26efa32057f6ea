"""Loading and saving of demonstrations; each format has its own module, listed in one table."""

import inspect
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.description import Description, describe
from torch_pbd.data.recordings import Missing
from torch_pbd.data.wanted import MAX_BYTES, OPTIONS, Arguments, Wanted, check_options, natural
from torch_pbd.exceptions import DataFormatError
from torch_pbd.files import LOADERS, replacing
from torch_pbd.files.memory import require_memory

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

# Bytes in memory per byte of a file that is read: measured are 1.5 for CSV, more with shorter numbers, 4 for Parquet.
_COPIES = 10

# Readers take (path, wanted, **options) and return arguments of Demonstrations; the path is added to their errors here.
# Their modules, with optional dependencies, are imported when a file of their kind is read.
_FORMATS = {".npz": "npz.read", ".npy": "npz.read_array_file", ".mat": "mat.read"}
_FORMATS |= dict.fromkeys([".csv", ".txt", ".tsv"], "csv.read")
_FORMATS |= dict.fromkeys([".bag", ".mcap", ".db3"], "rosbag.read")
_FORMATS |= {".parquet": "datasets.read_parquet", ".zip": "datasets.read_zarr"}
_FORMATS |= dict.fromkeys([".hdf5", ".h5"], "datasets.read_hdf5")
_WRITTEN = {".npz": "npz.write", ".csv": "csv.write"}
# Formats that are folders, recognized by a file that only they contain.
_FOLDERS = {
    "meta/info.json": "datasets.read_lerobot",
    ".zgroup": "datasets.read_zarr",
    "zarr.json": "datasets.read_zarr",
    "metadata.yaml": "rosbag.read",
}


def load_demonstrations(
    source: Source,
    *,
    outputs: str | Sequence[str] | None = None,
    demo: str | None = None,
    time: str | None = None,
    rotation: Sequence[str] | None = None,
    angles: str | Sequence[str] | None = None,
    units: str | Sequence[str] | None = None,
    time_unit: str | None = None,
    frame: str | None = None,
    rate: float | None = None,
    missing: Missing = "raise",
    in_units: str | Sequence[str] | None = None,
    cut: Literal["pauses"] | Sequence[tuple[float, float]] | None = None,
    trim: Literal["still"] | None = None,
    from_start: bool = False,
    max_bytes: int = MAX_BYTES,
    **options: Any,
) -> Demonstrations:
    """Load demonstrations from a file, a folder, or several files, in the format of the suffix.

    Tables (``.csv``, ``.txt``, ``.tsv``, ``.parquet``) have a header and one row per sample, in order of time within
    each demonstration. Arrays are ``.npz`` as written by `save_demonstrations` (``t`` and ``x``, or ``t_0``, ``x_0``,
    ``t_1``, ...) or with other names, ``.npy``, ``.mat``, ``.zarr`` and its ``.zip``. Data sets are folders of LeRobot
    (v2, v3) and ``.hdf5`` of robomimic. ROS recordings are folders of rosbag2, ``.mcap``, ``.db3`` and ``.bag``. The
    page "Recordings of every kind" has their layouts. Pickled objects are never loaded.

    Parameters
    ----------
    source : str, path-like, or sequence of them
        File, folder, several files, or a pattern such as "trial_*.csv", whose demonstrations are concatenated.
        Numbers in the names of a folder or a pattern are sorted as numbers.
    outputs : str or sequence of str, default=None
        Columns of the outputs, in this order; None takes the format's default, or all named columns that neither count
        rows (``frame_index``) nor number demonstrations (``task_index``).
    demo : str, default=None
        Column with a label of the demonstration, of any text; None takes "demo" if present, else a table is one
        demonstration. For bags it is a second topic of Bool, String or whole numbers (std_msgs): each stretch of
        constant value is a demonstration, except False, empty texts, and a 0 that recurs.
    time : str, default=None
        Column of times; None takes "time", or the format's default.
    rate : float, default=None
        Sampling rate in Hz of evenly spaced samples, which replaces the times in the file.
    rotation, angles, units, time_unit, frame, missing
        Parameters of `Demonstrations`; None takes those in the file, if any. Dates and times of day become seconds
        since the first of all files. Quaternions of ROS and robosuite are stored x y z w; ``rotation`` names w x y z.
    in_units : str or sequence of str, default=None
        Units to convert to, as by `Demonstrations.in_units`: "m", or ["m", "s"] with that of the times. ``units`` and
        ``time_unit`` describe the numbers in the file without converting them.
    cut, trim, from_start
        Whether to split one recording, remove stillness at ends, and count times from 0: see `Demonstrations`.
    max_bytes : int, default=512 MiB
        Largest size of a file (for .npz: unpacked) that is read.
    **options
        Options of a format. CSV: ``delimiter`` (None detects comma, semicolon or tab), ``decimal`` ("." or ",").
        ROS: ``topic``, and ``child``, the frame of transforms. HDF5: ``mask``, a list of demonstrations in the file.
        MATLAB: ``variable`` that holds the recordings.

    Raises
    ------
    FileNotFoundError, ModuleNotFoundError, ValueError, TypeError
        If there is no such file, a library is missing, the suffix is unknown, or an option is invalid.
    DataFormatError
        If the file does not match its suffix, with the array, or the line and the column; or if it is too large.
    """
    given = locals()
    return _load(source, Wanted(**{name: given[name] for name in OPTIONS}), options)


def inspect_demonstrations(source: Source, **options: Any) -> tuple[Demonstrations, Description]:
    """Load demonstrations as far as possible, with a description; takes the options of `load_demonstrations`.

    Contents that raise an error there are left out or guessed where possible, and listed in ``mistakes``.
    """
    notes: dict[str, str] = {}
    common = {name: options.pop(name) for name in OPTIONS if name in options}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        demonstrations = _load(source, Wanted(**common, notes=notes), options)
    told = {str(warning.message): "" for warning in caught}
    told.pop(" ".join(demonstrations.suspects), None)
    return demonstrations, describe(demonstrations, notes | told)


def find_files(source: Source) -> list[Path]:
    """Files of a source, or folders that are one recording; a FileNotFoundError if there are none."""
    if not source:
        raise checks.refusal(source, "source", "a path, or a list of some", "'.' is this folder")
    if isinstance(source, Sequence) and not isinstance(source, str):
        files = [file for entry in source for file in find_files(entry)]
        if len({file.resolve() for file in files}) < len(files):
            raise checks.refusal([*map(str, files)], "source", "of different files", "name each once")
        return files
    path = Path(source)
    if any(mark in path.name for mark in "*?[") and not path.exists():
        within = list(path.parent.glob(path.name))
        if not within:
            raise FileNotFoundError(f"{path} matches no file.")
    elif path.is_dir() and not _reader_of(path):
        within = list(filter(_reader_of, path.iterdir()))
        kinds = sorted({file.suffix.lower() for file in within})
        if len(kinds) != 1:
            what = f"files of several formats, {', '.join(kinds)}" if kinds else f"no file of {', '.join(_FORMATS)}"
            raise FileNotFoundError(f"the folder {path} has {what}: name those to read, as by {str(path / '*.csv')!r}.")
    else:
        return [path]
    return sorted(within, key=lambda file: natural(file.name))


def _load(source: Source, wanted: Wanted, options: dict[str, Any]) -> Demonstrations:
    files, parts = find_files(source), []
    contents = wanted.since_first([_read(file, wanted, options) for file in files])
    for file, content in zip(files, contents, strict=True):
        with _named(file):
            parts.append(Demonstrations(**content))
    return wanted.finish(parts)


def _read(file: Path, wanted: Wanted, options: dict[str, Any]) -> Arguments:
    reader = _function(file, _reader_of(file), _FORMATS)
    own = list(inspect.signature(reader).parameters)[2:]
    check_options(options, [*OPTIONS, *own], f"{file.suffix or file.name} files")
    if not file.exists():
        raise FileNotFoundError(f"{file} does not exist, or is not a file.")
    n_bytes = file.stat().st_size
    with _named(file):
        if file.is_file() and n_bytes > wanted.max_bytes:
            raise ValueError(f"it has {n_bytes} bytes, more than max_bytes={wanted.max_bytes}: raise it to read this.")
        require_memory(_COPIES * n_bytes, what="reading it", remedy="Split the file, or leave samples out.")
        return reader(file, wanted, **options)


@contextmanager
def _named(file: Path) -> Iterator[None]:
    """What goes wrong with the contents of a file is a DataFormatError that names it."""
    try:
        yield
    except ModuleNotFoundError:
        raise
    except Exception as error:  # parsers of bytes that are not what they claim to be raise errors of all kinds
        what = str(error) if isinstance(error, ValueError | TypeError) else f"{type(error).__name__}: {error}"
        raise DataFormatError(f"{file}: {what}") from error


def save_demonstrations(demonstrations: Demonstrations, path: str | os.PathLike[str]) -> None:
    """Write demonstrations to ``path``, in the format of its suffix (.npz or .csv).

    All numbers read back to the last bit. The file is written atomically and replaces an existing one. CSV files
    have no units, frame or checksum, and store rotations as quaternion columns qw, qx, qy, qz, which ``rotation`` must
    name on loading; .npz files store rotations as they are, with their reference.

    Raises a ValueError if the suffix is unknown, or an output's name cannot be a column of a CSV file.
    """
    file = Path(path)
    write = _function(file, _WRITTEN.get(file.suffix.lower()), _WRITTEN)
    with replacing(file) as handle:
        write(demonstrations, handle)


def _reader_of(path: Path) -> str | None:
    """Location of the reader of a file, or of a folder that is one recording; a .zip is a file."""
    own = None if path.is_dir() else _FORMATS.get(path.suffix.lower())
    return next((place for mark, place in _FOLDERS.items() if (path / mark).is_file()), own)


def _function(file: Path, place: str | None, table: dict[str, str]) -> Callable[..., Any]:
    if place is None:
        known = f"known formats of demonstrations: {', '.join(table)}"
        raise ValueError(f"{file} has the suffix {file.suffix!r}; {known}. {LOADERS}")
    module, name = place.split(".")
    return getattr(import_module(f"torch_pbd.data.formats.{module}"), name)
