"""Arrays in NumPy's .npz archives, read without taking their word for what they hold."""

import io
import math
import zipfile
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from torch_pbd.files.memory import require_memory

_ENTRY_BYTES = 1000  # of what zipfile keeps of a member
# NumPy writes 118 bytes for an array of a few axes. Headers are Python literals: short ones cannot nest deeply.
_LONGEST_HEADER = 1024
# Version 3 differs from 2 by UTF-8 in names of fields, which numbers and text do not have.
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0, (3, 0): npy.read_array_header_2_0}


def read_members(content: bytes, max_bytes: int, *, remedy: str) -> dict[str, bytes]:
    """Members of an archive by their names, without ``.npy``; nothing is written to the disk, whatever they say.

    Raises ValueError if it is damaged or not as NumPy writes it, has two members of one name, or unpacks to more than
    ``max_bytes`` or than the memory can take; ``remedy`` says what to do about ``max_bytes``.
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

    ``numpy.load`` would allocate whatever shape the header declares. Raises ValueError, which starts with ``name``, if
    the content is no such array, or has not as many bytes as its shape needs.
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
