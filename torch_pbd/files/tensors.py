"""Files of arrays and a JSON header under one checksum: safetensors, of which nothing is executed."""

import hashlib
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load, save

from torch_pbd.exceptions import ModelFileError
from torch_pbd.files import replacing
from torch_pbd.files.memory import require_memory

Arrays = dict[str, NDArray[Any]]

MAX_HEADER_BYTES = 2**22
"""Longest JSON header that is written or read, about 200 000 numbers: lists in it take up to 20 times the memory."""

_MAX_OUTER_BYTES = 4 * MAX_HEADER_BYTES  # the header of safetensors, in which ours is a string with escapes
_COPIES = 3.0  # the file, the arrays in it, and one array's bytes under the checksum


def write_checksummed(path: Path, key: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of numbers, and a header of what JSON can hold, to one file that is there whole or not.

    ``key`` is the kind of the file: the name of the header in the metadata of safetensors. The header has
    ``format_version``; ``sha256`` is added to it.

    Raises TypeError if the header is not for JSON, ValueError if it is longer than 4 MiB, and OSError, with the path,
    if the file cannot be written. Whose arrays they are says of what types and shapes they may be.
    """
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    # Through JSON once: the checksum is of what will be read again, lists where there were tuples.
    plain = json.loads(json.dumps(dict(header)))
    text = json.dumps({**plain, "sha256": _digest(plain, whole)})
    if len(text) > MAX_HEADER_BYTES:
        raise ValueError(
            f"the header of {path} has {len(text)} bytes, more than the {MAX_HEADER_BYTES} that are read again: "
            "keep long lists as arrays."
        )
    with replacing(path) as file:
        file.write(save(whole, metadata={key: text}))


def read_checksummed(path: Path, key: str, format_version: int) -> tuple[dict[str, Any], Arrays]:
    """Header, less its checksum, and arrays of a file that :func:`write_checksummed` wrote.

    Raises FileNotFoundError if there is no such file, and ModelFileError if it is not of this kind, of another
    ``format_version``, too large for the memory, or not as it was written: to the byte, but for the spelling of what
    safetensors says of the arrays.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model file at {path}")
    try:
        require_memory(_COPIES * path.stat().st_size, what=f"{path}", remedy="Read it where there is more.")
    except ValueError as error:
        raise ModelFileError(str(error)) from error
    try:
        # Not mapped into memory, as safe_open would: a file that shrinks while it is read would end the process.
        content = path.read_bytes()
        text, arrays = _unpacked(content, key)
        header = json.loads(text)
        # The checksum is of the content: another spelling of it would have the same.
        if json.dumps(header) != text:
            raise ValueError("its header is not as it was written")
    except Exception as error:  # parsers of bytes that are not what they claim to be raise errors of all kinds
        what = f"{str(error) or type(error).__name__:.200}"
        raise ModelFileError(f"{path} is not a model of {key}, or is damaged ({what}).") from error
    found = header.get("format_version") if isinstance(header, dict) else None
    if type(found) is not int or found != format_version:
        raise ModelFileError(
            f"{path} has format version {found!s:.40}; this torch_pbd reads {format_version}. Upgrade it."
        )
    if header.pop("sha256", None) != _digest(header, arrays):
        raise ModelFileError(f"{path} is damaged: it does not match its checksum.")
    return header, arrays


def _unpacked(content: bytes, key: str) -> tuple[str, Arrays]:
    """Our header as text, and the arrays: their bytes are as many as their shapes need."""
    (length,) = struct.unpack_from("<Q", content)
    if length > _MAX_OUTER_BYTES:
        raise ValueError(f"it declares a header of {length} bytes")
    arrays: Arrays = load(content)
    # Metadata, texts by their names, are read by safe_open alone. By now this is known to be a sound header.
    metadata = json.loads(content[8 : 8 + length]).get("__metadata__", {})
    if set(metadata) != {key}:
        raise ValueError(f"it is not marked {key!r}")
    text = metadata[key]
    if len(text) > MAX_HEADER_BYTES:
        raise ValueError(f"its header is longer than {MAX_HEADER_BYTES} bytes")
    return text, arrays


def _digest(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape} ".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()
