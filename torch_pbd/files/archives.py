"""Arrays in NumPy's .npz archives, read without taking their word for what they hold."""

import io
import math
import re
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.files.memory import require_memory

_ENTRY_BYTES = 1000  # of what zipfile keeps of a member
_NPY_START = re.compile(
    rb"\x93NUMPY(?:\x01\x00..|[\x02\x03]\x00....)"
    rb"\{'descr': '([<>|](?:[fiub]\d|U\d{1,9}))', 'fortran_order': (True|False), "
    rb"'shape': \(([\d, ]{0,200})\),? ?\} *\n",
    re.DOTALL,
)
# What reading raises about bytes that are no archive (RecursionError and NotImplementedError are RuntimeErrors).
_DAMAGE = (
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


def read_members(content: bytes, max_bytes: int, *, remedy: str) -> dict[str, bytes]:
    """Members of an archive by their names, without ``.npy``; nothing is written to the disk, whatever they say.

    Parameters
    ----------
    content : bytes
        The archive.
    max_bytes : int
        Most that it may unpack to.
    remedy : str
        What to do where it would be more.

    Raises
    ------
    ValueError
        If it is damaged or not as NumPy writes it, has two members of one name, or unpacks to more than ``max_bytes``
        or than the memory can take.
    """
    needed = _ENTRY_BYTES * content.count(b"PK\x01\x02")
    require_memory(needed + len(content), what="its list of members", remedy="Pack fewer arrays together.")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            _check_infos(infos, max_bytes, remedy)
            return {info.filename.removesuffix(".npy"): archive.read(info) for info in infos}
    except _DAMAGE as error:
        raise ValueError(f"it is not a sound .npz archive: {error}") from error


def _check_infos(infos: list[zipfile.ZipInfo], max_bytes: int, remedy: str) -> None:
    names = [info.filename.removesuffix(".npy") for info in infos]
    if len(set(names)) < len(names):
        raise ValueError("two of its members have the same name.")
    n_bytes = sum(info.file_size for info in infos)
    if n_bytes > max_bytes:
        raise ValueError(f"it unpacks to more than {max_bytes} bytes, to {n_bytes}. {remedy}")
    require_memory(2 * n_bytes, what="what it unpacks to", remedy="Read it where there is more.")
    if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in infos):
        raise ValueError("it is packed in a way that NumPy does not write.")


def read_array(name: str, content: bytes) -> NDArray[Any]:
    """An array of numbers, bools or text, as NumPy writes it; read-only, it takes no memory of its own.

    NumPy's own reader evaluates Python literals in the file, and allocates whatever shape it declares.

    Raises
    ------
    ValueError
        If it is none, or has not as many bytes as its shape needs; the message starts with ``name``.
    """
    start = _NPY_START.match(content)
    if start is None:
        raise ValueError(f"{name} is not an array of numbers or text in NumPy's format.")
    try:
        dtype = np.dtype(start[1].decode())
    except TypeError as error:
        raise ValueError(f"{name} is of an unknown type: {error}") from error
    shape = tuple(int(size) for size in start[3].split(b",") if size.strip())
    n_bytes, found = math.prod(shape) * dtype.itemsize, len(content) - start.end()
    if n_bytes != found:
        raise ValueError(f"{name} declares shape {shape}, {n_bytes} bytes, but has {found}.")
    array = np.frombuffer(content, dtype, offset=start.end())
    return array.reshape(shape, order="F" if start[2] == b"True" else "C")
