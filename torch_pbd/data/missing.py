"""Samples that were not recorded: found, counted, dropped."""

import sys
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.exceptions import MissingDataWarning

Arrays = list[NDArray[Any]]


def drop_missing(times: Arrays, positions: Arrays, min_samples: int) -> tuple[Arrays, Arrays, list[NDArray[np.intp]]]:
    """Demonstrations without the samples of which the time or a position is NaN; warns of how many these were.

    Parameters
    ----------
    times : list of K ndarrays of shape (T_k,)
    positions : list of K ndarrays of shape (T_k, d)
    min_samples : int
        Fewest samples that must be left of each.

    Returns
    -------
    times, positions : lists of K ndarrays
    kept : list of K ndarrays
        Numbers that the samples left had before.

    Raises
    ------
    ValueError
        If fewer are left.
    """
    holes = [np.isnan(time) | np.isnan(position).any(1) for time, position in zip(times, positions, strict=True)]
    for k, hole in enumerate(holes):
        n_left = len(hole) - int(hole.sum())
        if hole.any() and n_left < min_samples:
            raise ValueError(
                f"positions[{k}] has {n_left} of {len(hole)} samples left without missing values, must be at least "
                f"{min_samples}: leave this demonstration out, or fill the missing values in."
            )
    if any(hole.any() for hole in holes):
        warnings.warn(_report(holes), MissingDataWarning, stacklevel=levels_to_caller())
    kept = [np.flatnonzero(~hole) for hole in holes]
    return (
        [time[numbers] for time, numbers in zip(times, kept, strict=True)],
        [position[numbers] for position, numbers in zip(positions, kept, strict=True)],
        kept,
    )


def _report(holes: list[NDArray[np.bool_]]) -> str:
    counts = [f"{hole.sum()} of {len(hole)} in demonstration {k}" for k, hole in enumerate(holes) if hole.any()]
    shown = ", ".join(counts[:12]) + (f", ... ({len(counts)} demonstrations in all)" if len(counts) > 12 else "")
    total, longest = sum(int(hole.sum()) for hole in holes), max(_longest_run(hole) for hole in holes)
    return (
        f"Dropped {total} of {sum(map(len, holes))} samples that have missing values: {shown}. At most {longest} of "
        "them follow each other; what interpolates later draws straight lines there."
    )


def _longest_run(hole: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.r_[False, hole, False]))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def levels_to_caller() -> int:
    """How far up the first frame outside this package is, as ``stacklevel`` counts for who calls this."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("torch_pbd."):
        frame, level = frame.f_back, level + 1
    return level
