"""Checks of available memory, with an error and its remedy before the system would end the process."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

_SHARE = 0.8  # usable share of the available memory; the rest is for other processes
_GIB = 2.0**30
_MOST = 2.0**100  # bytes that are worth a number in a message
# Asking the system takes a millisecond, which small arrays are not worth.
_LITTLE = 2.0**26
# Bytes that Python takes for what these marks begin or end: numbers and their places, lists, mappings, strings.
_PARSED = {b",": 40.0, b";": 40.0, b"\t": 40.0, b"\n": 120.0, b"[": 80.0, b"{": 250.0, b'"': 30.0}
_CONTROL_GROUPS = Path("/proc/self/cgroup")
_MOUNT = Path("/sys/fs/cgroup")


def available_bytes() -> int:
    """Memory of this machine in bytes, or the limit of the control group that the process runs in, if lower.

    Containers and batch systems set such limits (cgroup v2 or v1). A system that does not tell has no end of memory.
    """
    try:
        physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        physical = 2**63 - 1
    return min([physical, *_control_group_limits()])


def require_memory(needed_bytes: float, *, what: str, remedy: str) -> None:
    """Refuse work that takes more than four fifths of :func:`available_bytes`, before it is begun.

    ``needed_bytes`` is an estimate of the most that is held at one time; ``what`` and ``remedy`` are the beginning and
    the end of the message: "a schedule of 3600001 ticks", "Lower rate."
    """
    usable = _SHARE * available_bytes()
    if needed_bytes > usable:
        gib = f"{needed_bytes / _GIB:.3g}" if needed_bytes < _MOST else f"more than {_MOST / _GIB:.0e}"
        raise ValueError(
            f"{what} needs about {gib} GiB of memory, but {usable / _GIB:.3g} GiB can be used here. {remedy}"
        )


def require_much(needed_bytes: float, *, what: str, remedy: str) -> None:
    """:func:`require_memory` for what may well be little: up to 64 MiB are taken to be there."""
    if needed_bytes > _LITTLE:
        require_memory(needed_bytes, what=what, remedy=remedy)


def parsed_bytes(text: Iterable[bytes]) -> float:
    """Estimate of the memory that numbers, lists and strings take that are read from pieces of JSON or of a table.

    Counted are the marks between them: what a short number takes may be 30 times its length.
    """
    return sum(2.0 * len(part) + sum(size * part.count(mark) for mark, size in _PARSED.items()) for part in text)


def _control_group_limits() -> Iterator[int]:
    """Limits of the process's memory group and of all above it, under either version of control groups."""
    lines: list[str] = []
    with suppress(OSError):
        lines = _CONTROL_GROUPS.read_text(encoding="utf-8").splitlines()
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        mount, file = (_MOUNT / "memory", "memory.limit_in_bytes") if controllers else (_MOUNT, "memory.max")
        group = mount / path.lstrip("/")
        # A container may see its own group as the root, under the path that it has outside.
        for folder in {folder for folder in (group, *group.parents, mount) if folder.is_relative_to(mount)}:
            with suppress(OSError, ValueError):  # absent, or "max": no limit
                yield int((folder / file).read_text(encoding="utf-8"))
