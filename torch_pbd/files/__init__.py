"""Atomic writing of files, and reading of arrays without trusting their contents."""

import errno
import io
import math
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from torch_pbd.files.memory import require_memory

Arrays = dict[str, NDArray[Any]]

LOADERS = (
    "Models are read by torch_pbd.load, schedules by torch_pbd.control.Schedule.load, demonstrations by "
    "torch_pbd.load_demonstrations."
)

_DRAFT = re.compile(r"\..+\.\d+\.[0-9a-f]{8}\.draft", re.DOTALL)
# What systems say of folders that cannot be opened, or not be told to reach the disk.
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOSYS}

_ENTRY_BYTES = 1000  # memory that zipfile needs per member
# NumPy writes 118 bytes for an array of a few axes. Headers are Python literals: short ones cannot nest deeply.
_LONGEST_HEADER = 1024
# Version 3 differs from 2 by UTF-8 in names of fields, which numbers and text do not have.
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0, (3, 0): npy.read_array_header_2_0}


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file beside ``path``, open for writing, that takes its place once it is complete and on the disk.

    On an error the old file is as it was. The new one has its permissions; where ``path`` is a link, the file that it
    leads to is replaced. An OSError has the path, which a full disk does not say.
    """
    file_path = _target(path)
    # In the same folder, as only within one file system a file takes another's place at once.
    draft = file_path.with_name(f".{file_path.name}.{os.getpid()}.{token_hex(4)}.draft")
    try:
        with draft.open("xb") as file:
            if file_path.exists():
                draft.chmod(file_path.stat().st_mode & 0o777)
            yield file
            file.flush()
            os.fsync(file.fileno())
        draft.replace(file_path)
        _sync_folder(file_path.parent)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        draft.unlink(missing_ok=True)


def remove_drafts(folder: Path) -> None:
    """Remove the files that :func:`replacing` left in a folder where a process was killed.

    Nothing else may write files there meanwhile: drafts of what still runs cannot be told from others.
    """
    for entry in list(folder.iterdir()):
        if _DRAFT.fullmatch(entry.name) and not entry.is_dir():
            entry.unlink(missing_ok=True)


def _target(path: Path) -> Path:
    """File to replace: the one that links lead to."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_symlink():  # still, after all have been followed: a circle
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder {target.parent} does not exist: make it before saving {path.name}.")
    if target.exists() and not target.is_file():
        number = errno.EISDIR if target.is_dir() else errno.EINVAL
        raise OSError(number, "a folder, a pipe or a device, in whose place no file can be put", str(path))
    return target


def _sync_folder(folder: Path) -> None:
    """Have the new name reach the disk too, on systems that can be asked for it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


def read_members(content: bytes, max_bytes: int, *, remedy: str) -> dict[str, bytes]:
    """Members of an archive by their names, without ``.npy``; nothing is written to the disk, whatever they say.

    A ValueError tells of an archive that NumPy does not write, or that unpacks to more than ``max_bytes``, for which
    ``remedy`` says what to do, or than the memory can take.
    """
    needed = _ENTRY_BYTES * content.count(b"PK\x01\x02") + len(content)
    require_memory(needed, what="its list of members", remedy="Pack fewer arrays together.")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            n_bytes = sum(info.file_size for info in infos)
            if len({info.filename.removesuffix(".npy") for info in infos}) < len(infos):
                raise ValueError("two of its members have the same name.")
            if n_bytes > max_bytes:
                raise ValueError(f"it unpacks to more than {max_bytes} bytes, to {n_bytes}. {remedy}")
            require_memory(2 * n_bytes, what="what it unpacks to", remedy="Read it where there is more.")
            if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in infos):
                raise ValueError("it is packed in a way that NumPy does not write.")
            return {info.filename.removesuffix(".npy"): archive.read(info) for info in infos}
    except Exception as error:  # parsers of bytes that are not what they claim to be raise errors of all kinds
        raise ValueError(f"it is not a sound .npz archive: {error}") from error


def read_array(name: str, content: bytes) -> NDArray[Any]:
    """Array of numbers, bools or text, as NumPy writes it; read-only, it takes no memory of its own.

    ``numpy.load`` would allocate whatever shape the header declares: here a ValueError, by ``name``, tells of it.
    """
    head = io.BytesIO(content[:_LONGEST_HEADER])
    try:
        shape, is_fortran, dtype = _HEADERS[npy.read_magic(head)](head)
        if dtype.kind not in "biufU" or min(shape, default=0) < 0:
            raise ValueError(f"it declares {dtype} and shape {shape}")
    except Exception as error:  # of literals that are none too
        raise ValueError(f"{name} is not an array of numbers or text in NumPy's format.") from error
    n_bytes, found = math.prod(shape) * dtype.itemsize, len(content) - head.tell()
    if n_bytes != found:
        raise ValueError(f"{name} declares shape {shape}, {n_bytes} bytes, but has {found}.")
    return np.frombuffer(content, dtype, offset=head.tell()).reshape(shape, order="F" if is_fortran else "C")
