"""Process CPU times of contenders that take turns."""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np


def alternate(
    contenders: Mapping[str, Callable[[], object]],
    n_repetitions: int,
    *,
    n_calls: int = 1,
    warm_up: bool = True,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """CPU seconds of one call of each contender, in every repetition.

    They take turns, in the opposite order every second time: what slows the machine for a while slows all of them.

    Parameters
    ----------
    contenders : mapping of str to callable
    n_repetitions : int
    n_calls : int, default=1
        Calls that are timed together, of work that is short beside a reading of the clock.
    warm_up : bool, default=True
        Whether each is called once before.
    clock : callable, default=time.process_time
        Seconds.
    """
    if warm_up:
        for work in contenders.values():
            work()
    times: dict[str, list[float]] = {name: [] for name in contenders}
    order = list(contenders)
    for _ in range(n_repetitions):
        for name in order:
            work, start = contenders[name], clock()
            for _ in range(n_calls):
                work()
            times[name].append((clock() - start) / n_calls)
        order.reverse()
    return times


def median(values: Sequence[float]) -> float:
    """Median of some times."""
    return float(np.median(values))


def ratios(other: Sequence[float], ours: Sequence[float]) -> list[float]:
    """How many times as long the other took, repetition by repetition; all pairs where they are not as many."""
    if len(other) == len(ours):
        return [theirs / mine for theirs, mine in zip(other, ours, strict=True)]
    return [theirs / mine for theirs in other for mine in ours]
