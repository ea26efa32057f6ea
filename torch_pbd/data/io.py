"""Demonstrations from files and to files: the doors; each format has its own module, named in one table."""

import inspect
import os
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.description import Description, describe
from torch_pbd.data.recordings import Missing
from torch_pbd.data.wanted import MAX_BYTES, OPTIONS, Wanted, check_options, natural
from torch_pbd.exceptions import DataFormatError
from torch_pbd.files import LOADERS, replacing
from torch_pbd.files.memory import require_memory

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]

# Bytes in memory for each of a file that is read; of CSV 1.5 are measured, more with shorter numbers, of Parquet 4.
_COPIES = 10

# Readers take (path, wanted, **options) and hand over arguments of Demonstrations; what they raise gets the path here.
# Their modules are imported when a file of their kind is met, and what they need from extras with them.
_FORMATS = {".npz": "npz.read", ".npy": "npz.read_array_file", ".mat": "mat.read"}
_FORMATS |= dict.fromkeys([".csv", ".txt", ".tsv"], "csv.read") | dict.fromkeys(
    [".bag", ".mcap", ".db3"], "rosbag.read"
)
_FORMATS |= {".parquet": "datasets.read_parquet", ".zip": "datasets.read_zarr"}
_FORMATS |= dict.fromkeys([".hdf5", ".h5"], "datasets.read_hdf5")
_WRITTEN = {".npz": "npz.write", ".csv": "csv.write"}
# Formats that are folders, by a file that only they have.
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
    """Demonstrations from a file, a folder, or several files, in the format that the suffix says.

    Tables: ``.csv``, ``.txt``, ``.tsv``, ``.parquet``, a header and a row a sample, each demonstration's in order of
    time. Arrays: ``.npz`` as `save_demonstrations` writes it (``t`` and ``x``, or ``t_0``, ``x_0``, ``t_1``, ...) or
    with other names, ``.npy``, ``.mat``, ``.zarr`` and ``.zip`` of one. Data sets: folders of LeRobot (v2, v3),
    ``.hdf5`` of robomimic. ROS: folders of rosbag2, ``.mcap``, ``.db3``, ``.bag``. The page "Recordings of every kind"
    has their layouts. Pickled objects are never loaded.

    Parameters
    ----------
    source : str, path-like, or sequence of them
        A file; a folder; several files or a pattern such as "trial_*.csv", in which demonstrations follow each other.
        Numbers in the names of a folder or a pattern are sorted as numbers.
    outputs : str or sequence of str, default=None
        Columns of the outputs, in the order wanted; None takes what the format means, or all the others, if each has a
        name, and none is a count of rows (``frame_index``) or a number of its demonstration (``task_index``).
    demo : str, default=None
        Column that tells the demonstrations apart, by any text. None takes "demo", if there is such a column; without
        it a table is one demonstration. Of bags a second topic, of Bool, String or whole numbers (std_msgs): each
        stretch over which it says the same is a demonstration, but for those of False, of an empty text, and of a 0
        that it comes back to.
    time : str, default=None
        Column of times; None takes "time", or what the format says.
    rate : float, default=None
        Samples a second, where the samples are evenly spaced: times are counted from it, and those of the file ignored.
    rotation, angles, units, time_unit, frame, missing
        As in `Demonstrations`; None takes those in the file, if it holds them. Dates and times of day become seconds
        from the first of all. Quaternions of ROS and robosuite stand as x y z w; ``rotation`` names them w x y z.
    in_units : str or sequence of str, default=None
        Convert to these units, as `Demonstrations.in_units` does: "m", or ["m", "s"] with that of the times. ``units``
        and ``time_unit`` say what the numbers in the file are, and change none of them.
    cut, trim, from_start
        One recording as several, no stillness at ends, times from 0: see the methods of `Demonstrations`.
    max_bytes : int, default=512 MiB
        Larger files (.npz: unpacked) are refused before they are read.
    **options
        Of a format. CSV: ``delimiter`` (None finds it among comma, semicolon and tab), ``decimal`` ("." or ",").
        ROS: ``topic``, and ``child``, the frame of transforms. HDF5: ``mask``, a list of demonstrations in the file.
        MATLAB: ``variable`` that holds the recordings.

    Raises
    ------
    FileNotFoundError, ModuleNotFoundError
        If there is no such file, or its format needs a library that is not installed.
    ValueError, TypeError
        If the suffix is not known, or an option is not as described, or not one of the format's.
    DataFormatError
        If the file is not what its suffix says, with the array, or the line and the column; or too large.
    """
    given = locals()
    return _read(source, Wanted(**{name: given[name] for name in OPTIONS}), options)


def inspect_demonstrations(source: Source, **options: Any) -> tuple[Demonstrations, Description]:
    """Demonstrations as far as they can be read, and their description; takes the options of `load_demonstrations`.

    What that function would refuse is left out or guessed, if there is a way, and said among the ``mistakes``.
    """
    notes: list[str] = []
    common = {name: options.pop(name) for name in OPTIONS if name in options}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        demonstrations = _read(source, Wanted(**common, notes=notes), options)
    suspects = " ".join(demonstrations.suspects)
    told = [message for message in (str(warning.message) for warning in caught) if message != suspects]
    return demonstrations, describe(demonstrations, [*dict.fromkeys(notes), *told])


def find_files(source: Source) -> list[Path]:
    """Files, or folders that are one recording, of a source; FileNotFoundError if there is none."""
    if isinstance(source, Sequence) and not isinstance(source, str):
        if not source:
            raise checks.refusal(source, "source", "a path, or a list of some")
        return [file for entry in source for file in find_files(entry)]
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


def _read(source: Source, wanted: Wanted, options: dict[str, Any]) -> Demonstrations:
    return wanted.finish([_load(file, wanted, options) for file in find_files(source)])


def _load(file: Path, wanted: Wanted, options: dict[str, Any]) -> Demonstrations:
    reader = _function(file, _reader_of(file), _FORMATS)
    own = list(inspect.signature(reader).parameters)[2:]
    check_options(options, [*OPTIONS, *own], f"{file.suffix or file.name} files")
    if not file.exists():
        raise FileNotFoundError(f"{file} does not exist, or is not a file.")
    n_bytes = file.stat().st_size
    try:
        if file.is_file() and n_bytes > wanted.max_bytes:
            raise ValueError(f"it has {n_bytes} bytes, more than max_bytes={wanted.max_bytes}: raise it to read this.")
        require_memory(_COPIES * n_bytes, what="reading it", remedy="Split the file, or leave samples out.")
        return Demonstrations(**reader(file, wanted, **options))
    except ModuleNotFoundError:
        raise
    except Exception as error:  # parsers of bytes that are not what they claim to be raise errors of all kinds
        what = str(error) if isinstance(error, ValueError | TypeError) else f"{type(error).__name__}: {error}"
        raise DataFormatError(f"{file}: {what}") from error


def save_demonstrations(demonstrations: Demonstrations, path: str | os.PathLike[str]) -> None:
    """Write demonstrations to ``path``, in the format that its suffix says (.npz or .csv).

    All numbers come back to the last bit. The file appears complete or not at all, and replaces one that is there.
    CSV files hold no units, no frame and no checksum, and rotations as quaternions, columns qw, qx, qy, qz, which are
    named by ``rotation`` to be read; .npz files hold them as they are, with their reference.

    Parameters
    ----------
    demonstrations : Demonstrations
    path : str or path-like
        Its folder must exist.

    Raises
    ------
    ValueError
        If the suffix is not known, or a name of an output cannot be a column of a CSV file.
    """
    file = Path(path)
    write = _function(file, _WRITTEN.get(file.suffix.lower()), _WRITTEN)
    with replacing(file) as handle:
        write(demonstrations, handle)


def _reader_of(path: Path) -> str | None:
    """Place of the reader of a file, or of a folder that is one recording; a .zip is a file."""
    own = None if path.is_dir() else _FORMATS.get(path.suffix.lower())
    return next((place for mark, place in _FOLDERS.items() if (path / mark).is_file()), own)


def _function(file: Path, place: str | None, table: dict[str, str]) -> Callable[..., Any]:
    if place is None:
        known = f"known formats of demonstrations: {', '.join(table)}"
        raise ValueError(f"{file} has the suffix {file.suffix!r}; {known}. {LOADERS}")
    module, name = place.split(".")
    return getattr(import_module(f"torch_pbd.data.formats.{module}"), name)
