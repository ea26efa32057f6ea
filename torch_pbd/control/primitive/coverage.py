"""Where the samples of recordings are: those that are one, and the holes between them."""

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data import Demonstrations
from torch_pbd.data.recordings import preview

Floats = NDArray[np.float64]

UNKNOWN = 0.5
"""Type I uncertainty above which nothing is known: ``on_unknown="raise"`` raises."""

# Of the mean spacing: clocks do not jitter by as little, drivers that number repeated stamps do. Bursts of five samples
# 1e-9 to 1e-6 s apart, differentiated as they are, make a path of 8.7e7 m of recordings that stay within 0.41 m.
_RESOLUTION = 1e-3
# A movement is known up to 2.5 spacings from a sample, as in a dropout of three whose neighbours jitter, and no longer
# at five. Of a finer sampling five count as a 40th of the movement, which is one cycle of the automatic cutoff.
_KNOWN, _LOST, _FINEST = 2.5, 5.0, 200
_INTERVALS = 4000  # of a table: 200 in the shortest hole, of 7.5 spacings


def merge_bursts(demonstrations: Demonstrations) -> Demonstrations:
    """Demonstrations whose samples closer than a thousandth of the mean spacing are one, at their mean.

    The median spacing is no measure: of bursts it is the distance within them. Warns of how many there were, and where.
    """
    merged = [_merge(*recording) for recording in demonstrations]
    lost = [(k, n, n - len(merged[k][0])) for k, n in enumerate(demonstrations.n_steps) if n > len(merged[k][0])]
    if not lost:
        return demonstrations
    checks.warn(
        f"{sum(few for *_, few in lost)} samples come less than a thousandth of the mean spacing after the one before "
        f"and were merged with it: {preview([f'{few} of {n} in demonstration {k}' for k, n, few in lost])}. Take times "
        "from a clock that resolves them, or drop repeated samples."
    )
    labels = {name: getattr(demonstrations, name) for name in ("names", "units", "frame", "time_unit")}
    return Demonstrations([time for time, _ in merged], [position for _, position in merged], **labels)


def _merge(time: Floats, position: Floats) -> tuple[Floats, Floats]:
    # Bursts make the mean spacing short, which grows as they are merged: again until none is left.
    while not (apart := np.diff(time) >= _RESOLUTION * (time[-1] - time[0]) / (len(time) - 1)).all():
        first = np.flatnonzero(np.r_[True, apart])
        counts = np.diff(np.r_[first, len(time)])
        time = time[0] + np.add.reduceat(time - time[0], first) / counts
        position = position[0] + np.add.reduceat(position - position[0], first) / counts[:, np.newaxis]
    return time, position


def spacing_of(time: Floats) -> float:
    """Distance of neighbouring samples: the median of those that a 400th of the recording tells apart.

    Of recordings finer than 200 samples it is a 200th: their shortest hole is then a matter of the movement.
    """
    lasting = time[-1] - time[0]
    _, first = np.unique(np.floor(2 * _FINEST * ((time - time[0]) / lasting)), return_index=True)
    return max(float(np.median(np.diff(time[first]))), lasting / _FINEST)


def holes_of(time: Floats) -> NDArray[np.intp]:
    """Indices (m,) of the samples before a hole: 7.5 spacings or more, whose middle is unknown."""
    return np.flatnonzero(np.diff(time) > (_KNOWN + _LOST) * spacing_of(time))


def unsampled(time: Floats, at: Floats) -> Floats:
    """Type I uncertainty (m,) of one recording at times (m,) within it: 0 near its samples, 1 far from them."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    distance = np.minimum(np.abs(at - time[after - 1]), np.abs(time[after] - at))
    share = np.clip((distance / spacing_of(time) - _KNOWN) / (_LOST - _KNOWN), 0.0, 1.0)
    # A smooth step, so that stiffness has no corner where knowledge ends.
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def tabulate_unsampled(demonstrations: Demonstrations, lasting: float, on_unknown: str) -> Floats:
    """Type I uncertainty at 4001 even times from the start to the end to which all recordings are stretched.

    It is the second lowest of the recordings' there: from one alone nothing is known of how they vary. Warns of the
    holes that all share but one, at times in a movement of ``lasting``.
    """
    share, each = np.linspace(0.0, 1.0, _INTERVALS + 1), []
    inside = np.zeros(len(share))
    for time in demonstrations.times:
        each.append(unsampled(time, at := time[0] + share * (time[-1] - time[0])))
        inside += sum((at > time[i]) & (at < time[i + 1]) for i in holes_of(time))
    table = np.asarray(np.partition(each, 1, axis=0)[1])
    edges = np.flatnonzero(np.diff(np.r_[False, inside >= len(each) - 1, False])).reshape(-1, 2)
    holes = [
        f"{lasting * share[a - 1]:.3g} to {lasting * share[b]:.3g}" for a, b in edges if table[a:b].max() > UNKNOWN
    ]
    if holes:
        checks.warn(
            f"Fewer than two of {len(each)} demonstrations have samples at {preview(holes)} {demonstrations.time_unit} "
            f"after the start: how they vary there is unknown, and on_unknown={on_unknown!r} decides on the "
            "stiffness. Record what is missing."
        )
    return table
