"""Writing a file so that it is there whole, or as it was before."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO

LOADERS = (
    "Models are read by torch_pbd.load, schedules by torch_pbd.control.Schedule.load, demonstrations by "
    "torch_pbd.load_demonstrations."
)

_DRAFT = re.compile(r"\..+\.\d+\.[0-9a-f]{8}\.draft", re.DOTALL)
# What systems say of folders that cannot be opened, or not be told to reach the disk.
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOSYS}


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file beside ``path``, open for writing, that takes its place once it is complete and on the disk.

    A reader sees the old file or the new one; on an error the old one is as it was. The new one has the permissions
    of the old one. Where ``path`` is a link, the file that it leads to is replaced, and the link stays.

    Raises FileNotFoundError if its folder does not exist, and OSError, with the path (which a full disk does not say),
    if it cannot be written, or is a folder, a pipe or a device.
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


def remove_drafts(folder: Path) -> int:
    """Remove what :func:`replacing` has left in a folder where a process was killed or the power failed.

    Nothing else may write files there meanwhile: drafts of what still runs cannot be told from others. Folders in it
    are left alone; what comes back is the number of drafts.
    """
    drafts = [entry for entry in folder.iterdir() if _DRAFT.fullmatch(entry.name) and not entry.is_dir()]
    for draft in drafts:
        draft.unlink(missing_ok=True)
    return len(drafts)


def _target(path: Path) -> Path:
    """File to replace: the one that links lead to."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_symlink():  # still, after all have been followed: a circle
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder {target.parent} does not exist: make it before saving {path.name}.")
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if target.exists() and not target.is_file():
        raise OSError(errno.EINVAL, "a pipe or a device, in whose place no file can be put", str(path))
    return target


def _sync_folder(folder: Path) -> None:
    """Have the new name reach the disk too, on systems that can be asked for it."""
    descriptor = None
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
    finally:
        if descriptor is not None:
            os.close(descriptor)
