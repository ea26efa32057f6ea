"""Writing a file so that it is there whole, or as it was before."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file beside ``path``, open for writing, that takes its place once it is complete and on the disk.

    A reader sees the old file or the new one; on an error the old one is as it was.

    Raises
    ------
    FileNotFoundError
        If its folder does not exist.
    OSError
        If it cannot be written; with the path, which a full disk does not say.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: make it before saving {path.name}.")
    draft = path.with_name(f".{path.name}.{os.getpid()}.{token_hex(4)}")
    try:
        with draft.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        draft.unlink(missing_ok=True)
