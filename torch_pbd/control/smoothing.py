"""Positions, velocities and accelerations of recorded movements, at their true times, by smoothing splines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline, make_smoothing_spline

from torch_pbd.data import Demonstrations
from torch_pbd.data.alignment import interpolate

Floats = NDArray[np.float64]

CUTOFF_HZ = 4.0
"""Cutoff of slow movements: hands move below it, and tremor (8 to 12 Hz) and encoders' steps are above."""

CUTOFF_CYCLES = 40.0
"""Least cutoff of any movement, in cycles a movement: fast ones have detail above 4 Hz."""

_LEAST_SAMPLES = {True: 5, False: 3}


@dataclass(frozen=True)
class Movements:
    """K movements at n common movement times, derivatives with respect to movement time.

    Attributes
    ----------
    time : ndarray of shape (n,)
        From 0 to the duration, s; each demonstration is stretched to it linearly.
    position, velocity, acceleration : ndarray of shape (K, n, d)
    recorded_mean : ndarray of shape (n, d)
        Mean position as it was recorded, not smoothed.
    noise_scale : ndarray of shape (d,)
        Root mean square of what the smoothing took away, in the units of position.
    """

    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    recorded_mean: Floats
    noise_scale: Floats


def smooth(demonstrations: Demonstrations, cutoff: float | None, n_steps: int, duration: float) -> Movements:
    """Smooth each demonstration, and sample all at ``n_steps`` common movement times.

    With a cutoff each output is the cubic smoothing spline whose weight halves the amplitude at the cutoff: at
    even sampling it is a Butterworth filter of second order run forward and backward, and it takes the times
    as they are, even or not. Without one it is the spline of degree 5 (3 below six samples) through all
    samples: exact for polynomials, and noise goes through, times the square of its frequency in the
    acceleration.

    Parameters
    ----------
    demonstrations : Demonstrations
    cutoff : float or None
        In Hz of movement time.
    n_steps : int
    duration : float
        Of the movement, s: each demonstration is stretched to it, and a cutoff with the median of them.

    Raises
    ------
    ValueError
        If a demonstration has too few samples.
    """
    least = _LEAST_SAMPLES[cutoff is not None]
    for number, n_samples in enumerate(demonstrations.n_steps):
        if n_samples < least:
            purpose = "to be smoothed, or cutoff=None for 3" if cutoff is not None else "for an acceleration"
            raise ValueError(
                f"demonstration {number} has {n_samples} samples, needs at least {least} {purpose}: leave it out, or "
                "record it at a higher rate."
            )
    durations = [time[-1] - time[0] for time in demonstrations.times]
    own_cutoff = None if cutoff is None else cutoff * duration / float(np.median(durations))
    grid = np.linspace(0.0, duration, n_steps)
    motions, removed, recorded = [], [], []
    for (time, position), lasting in zip(demonstrations, durations, strict=True):
        stretch = lasting / duration
        spline = _spline(time - time[0], position, own_cutoff)
        own = np.clip(grid * stretch, 0.0, lasting)
        motions.append([spline(own, order) * stretch**order for order in range(3)])
        removed.append(position - spline(time - time[0]))
        recorded.append(interpolate(time - time[0], position, own))
    position, velocity, acceleration = (np.stack(parts) for parts in zip(*motions, strict=True))
    noise_scale = np.sqrt(np.mean(np.concatenate(removed) ** 2, axis=0))
    return Movements(grid, position, velocity, acceleration, np.mean(recorded, axis=0), noise_scale)


def _spline(time: Floats, position: Floats, cutoff: float | None) -> BSpline:
    if cutoff is None:
        return make_interp_spline(time, position, k=5 if len(time) > 5 else min(3, len(time) - 1))
    # Weights by the spacing make the sum an integral: lam = 1 / w^4 then halves the amplitude at w. In units of
    # the mean spacing and of each output's spread, which keeps the spline's equations well conditioned.
    spacing = np.gradient(time)
    unit = spacing.mean()
    offset = position.mean(axis=0)
    spread = np.ptp(position, axis=0)
    scale = np.where(spread > 0.0, spread, 1.0)
    weight = 1.0 / (2.0 * np.pi * cutoff * unit) ** 4
    smoothed = make_smoothing_spline(time / unit, (position - offset) / scale, spacing / unit, weight)
    return BSpline(smoothed.t * unit, smoothed.c * scale + offset, smoothed.k)


def automatic_cutoff(duration: float, *, knows_seconds: bool) -> float:
    """40 cycles a movement of ``duration`` s; where the recordings tell seconds, not below 4 Hz."""
    return max(CUTOFF_HZ if knows_seconds else 0.0, CUTOFF_CYCLES / duration)


def noise_like(demonstrations: Demonstrations, noise_scale: Floats) -> Demonstrations:
    """White noise of that scale at the sampling times of the demonstrations: what smoothing makes of it is noise."""
    random = np.random.default_rng(0)
    noise = [random.normal(size=(n, demonstrations.n_outputs)) * noise_scale for n in demonstrations.n_steps]
    return Demonstrations(demonstrations.times, noise, time_unit=demonstrations.time_unit)


def variance_share(part: Floats, whole: Floats) -> Floats:
    """Variance between demonstrations of one set of movements (K, n, d) over that of another, (d,), at most 1."""
    variance = whole.var(axis=0, ddof=1).mean(axis=0)
    share = part.var(axis=0, ddof=1).mean(axis=0) / np.where(variance > 0.0, variance, np.inf)
    return np.minimum(share, 1.0)
