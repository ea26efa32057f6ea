"""Preprocessing of recordings for a controller: merged bursts, gaps, and derivatives by smoothing splines."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicHermiteSpline, make_interp_spline

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data import Demonstrations
from torch_pbd.data.recordings import preview
from torch_pbd.data.sampling import KNOWN, LEAST_SAMPLES, LOST, holes_of, smoothing_spline, spacing_of
from torch_pbd.data.units import TIMES
from torch_pbd.files.memory import require_much

UNKNOWN = 0.5
"""Type I uncertainty above which nothing is known: ``on_unknown="raise"`` raises."""

# Share of the mean spacing below which samples merge: clocks jitter by more, drivers that number repeated stamps by
# less. Bursts of five samples 1e-9 to 1e-6 s apart, left unmerged, make a path of 8.7e7 m of recordings within 0.41 m.
_RESOLUTION = 1e-3
_INTERVALS = 4000  # intervals of a table, which gives the shortest gap, of 7.5 spacings, 200 of them
# Least cutoff in Hz: hands move below it, and tremor (8 to 12 Hz) and steps of encoders are above. Fast movements have
# detail above 4 Hz: of them it is 40 cycles in a movement.
CUTOFF_HZ, CUTOFF_CYCLES = 4.0, 40.0
_MOST_BEYOND = 0.1  # allowed excess of an output's range in all recordings; paths through gaps keep to half of it
# Measured, in numbers: of each of a demonstration's positions while it is smoothed; of each pair of steps while the
# forcing is learned, in all and of each axis where they are many; of each axis at a step, while it is tabulated.
_SMOOTHED, _PAIRED, _PAIRED_AXIS, _TABULATED = 10.0, 34.0, 5.0, 16e3


@dataclass(frozen=True)
class Movements:
    """K movements (K, n, d) at n common times in s, from 0 to the duration, to which each is stretched linearly.

    ``known`` (K, n) is where each has samples near, ``recorded_mean`` (n, d) the mean as recorded, not smoothed but for
    holes. ``bounds`` (2, d) are the lowest and highest position of all recordings, ``noise_scale`` (d,) the root mean
    square of what the smoothing took away.
    """

    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    recorded_mean: Floats
    bounds: Floats
    known: NDArray[np.bool_]
    noise_scale: Floats


def smooth(
    times: Sequence[Floats],
    positions: Sequence[Floats],
    cutoff: float | None,
    n_steps: int,
    duration: float,
    *,
    noise: bool = False,
) -> Movements:
    """Smooth each demonstration, times (T_k,) and positions (T_k, d), and sample all at ``n_steps`` common times.

    With a cutoff, in Hz of the movement, each output is the cubic smoothing spline whose weight halves the amplitude
    there: at even sampling it is a Butterworth filter of second order run forward and backward, and it takes the times
    as they are. Without one it is the spline of degree 5 (3 below six samples) through all samples. Unless it is
    ``noise``, a path that leaves the recorded range by a tenth is refused.
    """
    least, purpose = 3, "for an acceleration"
    if cutoff is not None:
        least, purpose = LEAST_SAMPLES, "to be smoothed, or cutoff=None for 3"
    for number, n_samples in enumerate(map(len, times)):
        if n_samples < least:
            raise ValueError(
                f"demonstration {number} has {n_samples} samples, needs at least {least} {purpose}: leave it out, or "
                "record it at a higher rate."
            )
    times = [time - time[0] for time in times]
    own_cutoff = None if cutoff is None else cutoff * duration / float(np.median([time[-1] for time in times]))
    samples = np.concatenate(positions)
    bounds = np.stack([samples.min(axis=0), samples.max(axis=0)])
    splines = _splines(times, positions, own_cutoff, bounds)
    grid = np.linspace(0.0, duration, n_steps)
    motions, removed, recorded, known = [], [], [], []
    for time, position, spline in zip(times, positions, splines, strict=True):
        stretch = time[-1] / duration
        own = np.clip(grid * stretch, 0.0, time[-1])
        motions.append([spline(own, order) * stretch**order for order in range(3)])
        removed.append(position - spline(time))
        known.append(unsampled(time, own) <= UNKNOWN)
        linear = make_interp_spline(time, position, k=1)
        recorded.append(np.where(known[-1][:, np.newaxis], linear(own), motions[-1][0]))
    position, velocity, acceleration = (np.stack(parts) for parts in zip(*motions, strict=True))
    for number, path in enumerate(() if noise else position):
        check_range(path, bounds, f"demonstration {number}, smoothed,")
    mean, noise_scale = np.mean(recorded, axis=0), np.sqrt(np.mean(np.concatenate(removed) ** 2, axis=0))
    return Movements(grid, position, velocity, acceleration, mean, bounds, np.stack(known), noise_scale)


def check_steps(n_steps: int, n_demos: int, d: int, *, learned: bool) -> None:
    """Check that ``n_steps`` fit in memory, smoothed and, if ``learned``, with the forcing learned."""
    n = float(n_steps)
    needed = _SMOOTHED * n * n_demos * d
    if learned:  # Gaussian processes have matrices of all pairs of points, unless a few nodes carry the forcing
        needed += n * (max(_PAIRED, _PAIRED_AXIS * d) * n + _TABULATED * d)
    require_much(
        8.0 * needed,
        what=f"n_steps={n_steps} of {n_demos} demonstrations of {d} axes",
        remedy="Lower n_steps: 100 to 500 follow most movements.",
    )


def check_range(path: Floats, bounds: Floats, name: str) -> None:
    """Raise if a path (n, d) leaves the recorded bounds (2, d) of an output by more than a tenth of its range."""
    # Rounding of positions far from their origin leaves no range.
    beyond = np.maximum(bounds[0] - path, path - bounds[1]).max(axis=0) - 1e-11 * np.abs(bounds).max(axis=0)
    ranges = np.ptp(bounds, axis=0)
    if (beyond > _MOST_BEYOND * ranges).any():
        output = int(np.argmax(beyond - _MOST_BEYOND * ranges))
        raise ValueError(
            f"{name} leaves the recorded range of output {output}, {ranges[output]:.3g}, by {beyond[output]:.3g}, must "
            f"stay within {_MOST_BEYOND:g} of it: lower the cutoff, take phase_input='time', or correct times that are "
            "too close to others or not in time_unit."
        )


def _splines(
    times: Sequence[Floats], positions: Sequence[Floats], cutoff: float | None, bounds: Floats
) -> list[BSpline]:
    """Spline of each demonstration over its time from its start; in a hole near the mean of those that have none."""
    margin = 0.5 * _MOST_BEYOND * np.ptp(bounds, axis=0)
    splines = [_spline(*recording, cutoff) for recording in zip(times, positions, strict=True)]
    bridged = splines.copy()
    # Holes are filled at the recording's own spacing, by the splines before any was, so that no order matters.
    for number, (time, filled) in enumerate(zip(times, positions, strict=True)):
        samples = time
        for edges in [time[i : i + 2] for i in holes_of(time)]:
            inner = np.linspace(edges[0], edges[1], round(np.ptp(edges) / spacing_of(time)) + 1)[1:-1]
            path = np.clip(_through(splines, times, number, edges, inner), bounds[0] - margin, bounds[1] + margin)
            after = np.searchsorted(samples, inner)
            samples, filled = np.insert(samples, after, inner), np.insert(filled, after, path, axis=0)
        if len(samples) > len(time):
            bridged[number] = _spline(samples, filled, cutoff)
    return bridged


def _through(splines: list[BSpline], times: Sequence[Floats], number: int, edges: Floats, inner: Floats) -> Floats:
    """Path of one demonstration at times ``inner`` of its hole between ``edges``."""
    rates = [time[-1] / times[number][-1] for time in times]
    sampled = [k for k, time in enumerate(times) if unsampled(time, rates[k] * inner).max() <= UNKNOWN]

    def mean(at: Floats, order: int = 0) -> Any:
        return sum(splines[k](rates[k] * at, order) * rates[k] ** order for k in sampled) / max(1, len(sampled))

    # The mean of the others, and the cubic that has the difference and its slope at both edges. Of no others, the mean
    # is zero, and the cubic is all.
    own = splines[number]
    return mean(inner) + CubicHermiteSpline(edges, own(edges) - mean(edges), own(edges, 1) - mean(edges, 1))(inner)


def _spline(time: Floats, position: Floats, cutoff: float | None) -> BSpline:
    if cutoff is None:
        return make_interp_spline(time, position, k=5 if len(time) > 5 else min(3, len(time) - 1))
    return smoothing_spline(time, position, cutoff)


def smoothed_noise(movements: Movements, times: Sequence[Floats], cutoff: float | None) -> Movements:
    """White noise as large as what was taken away from movements, smoothed as they were."""
    random, scale = np.random.default_rng(0), movements.noise_scale
    noise = [random.normal(size=(len(time), len(scale))) * scale for time in times]
    return smooth(times, noise, cutoff, len(movements.time), float(movements.time[-1]), noise=True)


def variance_share(part: Floats, whole: Floats) -> Floats:
    """Variance between demonstrations of one set of movements (K, n, d) over that of another, (d,), at most 1."""
    own, variance = (values.var(axis=0, ddof=1).mean(axis=0) for values in (part, whole))
    return np.minimum(own / np.where(variance > 0.0, variance, np.inf), 1.0)


def merge_bursts(demonstrations: Demonstrations) -> Demonstrations:
    """Demonstrations with samples closer than a thousandth of the mean spacing merged at their mean, with a warning."""
    merged = [_merge(*recording) for recording in demonstrations]
    lost = [(k, n, n - len(merged[k][0])) for k, n in enumerate(demonstrations.n_steps) if n > len(merged[k][0])]
    if not lost:
        return demonstrations
    checks.warn(
        f"{sum(few for *_, few in lost)} samples come less than a thousandth of the mean spacing after the one before "
        f"and were merged with it: {preview([f'{few} of {n} in demonstration {k}' for k, n, few in lost])}. Take times "
        "from a clock that resolves them, or drop repeated samples."
    )
    return demonstrations._replace(*zip(*merged, strict=True))


def _merge(time: Floats, position: Floats) -> tuple[Floats, Floats]:
    # The median spacing is no measure: of bursts it is the distance within them. They make the mean spacing short,
    # which grows as they are merged: again until none is left.
    while not (apart := np.diff(time) >= _RESOLUTION * (time[-1] - time[0]) / (len(time) - 1)).all():
        first = np.flatnonzero(np.r_[True, apart])
        counts = np.diff(np.r_[first, len(time)])
        time = time[0] + np.add.reduceat(time - time[0], first) / counts
        position = position[0] + np.add.reduceat(position - position[0], first) / counts[:, np.newaxis]
    return time, position


def unsampled(time: Floats, at: Floats) -> Floats:
    """Type I uncertainty (m,) of one recording at times (m,) within it: 0 near its samples, 1 far from them."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    distance = np.minimum(np.abs(at - time[after - 1]), np.abs(time[after] - at))
    share = np.clip((distance / spacing_of(time) - KNOWN) / (LOST - KNOWN), 0.0, 1.0)
    # A smooth step, so that stiffness has no corner where knowledge ends.
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def tabulate_unsampled(demonstrations: Demonstrations, lasting: float, on_unknown: str) -> Floats:
    """Type I uncertainty at 4001 even times from the start to the end, the second lowest of all recordings.

    From one alone nothing is known of how they vary. Holes that all share but one are told, at times of ``lasting``.
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


def duration_of(demonstrations: Demonstrations, duration: float | None) -> tuple[float, float]:
    """Duration in s, by default the median of the demonstrations, and seconds per unit of their time."""
    own, unit = float(np.median([time[-1] - time[0] for time in demonstrations.times])), demonstrations.time_unit
    if duration is not None:
        return float(duration), duration / own
    if unit not in TIMES:
        checks.warn(
            f"The times of the demonstrations are in {unit!r}, not in s: the movement is taken to last {own:.3g} s. "
            "Give duration, in s."
        )
    return own * TIMES.get(unit, 1.0), TIMES.get(unit, 1.0)


def common_start(demonstrations: Demonstrations) -> float:
    """Time at which the demonstrations start, up to a sample; 0 where they start at different times."""
    starts = np.array([time[0] for time in demonstrations.times])
    step = np.median([np.median(np.diff(time)) for time in demonstrations.times])
    return float(np.median(starts)) if np.ptp(starts) <= step else 0.0
