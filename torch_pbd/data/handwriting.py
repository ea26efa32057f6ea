"""Strokes of handwriting whose law is known: minimum-jerk movements through via points, some precise and some free."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.synthetic import Random, Seed, band_noise, check_recording, column, generator

Shape = Literal["C", "G", "J", "S", "W", "Z"]

# Via points of each letter, 10 cm high: x and y in cm, and how far people are from them, across the path, in mm.
_VIA_POINTS = {
    "C": [(7, 8.4, 2), (3.5, 10, 6), (0.2, 5, 9), (3.5, 0, 6), (7, 1.6, 1)],
    "G": [(7, 8.6, 2), (3.5, 10, 6), (0.1, 5, 9), (3.5, 0, 5), (7, 2, 3), (6.9, 4.4, 1), (4.2, 4.5, 1)],
    "J": [(5.5, 10, 1), (5.5, 6.5, 6), (5.4, 3, 8), (3.2, 0, 4), (0.4, 2.4, 1)],
    "S": [(6.6, 8.6, 3), (3.5, 10, 8), (0.5, 7.6, 7), (3.5, 5.1, 1), (6.6, 2.5, 6), (3.4, 0, 8), (0.2, 1.4, 1)],
    "W": [(0, 10, 4), (2.3, 0, 1), (4.6, 8, 8), (6.9, 0, 1), (9.2, 10, 4)],
    "Z": [(0, 10, 1), (3.5, 10.1, 6), (7, 10, 1), (3.5, 5, 9), (0, 0, 1), (3.5, -0.1, 6), (7, 0, 1)],
}
_ALONG = 0.5  # of the deviation across: people keep a path better than its pace
_TREMOR = 2e-4  # rms in m, up to 2 Hz: no output is ever free of it


def handwriting_mean(phase: ArrayLike, shape: Shape = "S") -> Floats:
    """Mean (n, 2) of a letter in m, at phases (n,) or (n, 1) from 0, its start, to 1, its end."""
    via_points, _ = _via_law(shape, None)
    return minimum_jerk(via_points)(phases(phase)) @ via_points


def handwriting_covariance(phase: ArrayLike, shape: Shape = "S", *, via_precision: ArrayLike | None = None) -> Floats:
    """Covariance (n, 2, 2) over demonstrations of a letter in m^2, at phases (n,) or (n, 1) from 0 to 1.

    ``via_precision`` is that of `make_handwriting_demonstrations`.
    """
    via_points, covariances = _via_law(shape, via_precision)
    # A movement is linear in its via points, which are independent: x = sum_k b_k p_k, so C = sum_k b_k^2 C_k.
    weights = minimum_jerk(via_points)(phases(phase)) ** 2
    return np.einsum("nk,kij->nij", weights, covariances) + _TREMOR**2 * np.eye(2)


def make_handwriting_demonstrations(
    shape: Shape = "S",
    n_demos: int = 6,
    *,
    duration: float = 2.0,
    rate: float = 100.0,
    via_precision: ArrayLike | None = None,
    timing: float = 0.1,
    random_state: Seed = None,
) -> Demonstrations:
    """A letter written several times: minimum-jerk movements through via points that differ between demonstrations.

    Each movement starts and ends at rest and has the least jerk of those that pass its via points at their phases
    (T. Flash, N. Hogan, Journal of Neuroscience 5, 1985): the quintic spline through them. Via points are normal and
    independent; across the path with the deviation ``via_precision``, along it with half of that. A tremor of 0.2 mm
    rms up to 2 Hz is added.

    Parameters
    ----------
    shape : {"C", "G", "J", "S", "W", "Z"}, default="S"
        Letters 10 cm high, of five to seven via points.
    n_demos : int, default=6
    duration : float, default=2.0
        In s; of each demonstration where ``timing`` is 0.
    rate : float, default=100.0
        Samples a second.
    via_precision : float or array_like of shape (n_via_points,), default=None
        Standard deviation across the path at each via point, or at all of them, in m. None: those of the letter, 1 mm
        where it is written precisely, up to 9 mm where it is free.
    timing : float, default=0.1
        Relative standard deviation of durations and of the pace within a demonstration, below 0.5. With 0 all
        demonstrations share one grid, and time / duration is the phase of the truth.
    random_state : int, Generator, RandomState or None, default=None

    Returns
    -------
    Demonstrations
        Outputs x and y in m, times in s.

    See Also
    --------
    handwriting_mean, handwriting_covariance : The law over the phase, exactly.

    Examples
    --------
    >>> from torch_pbd.data import make_handwriting_demonstrations
    >>> make_handwriting_demonstrations("G", timing=0.0, random_state=0)
    Demonstrations(n_demos=6, n_steps=201, outputs=('x', 'y'), time_unit='s', aligned=True)
    """
    via_points, covariances = _via_law(shape, via_precision)
    check_recording(n_demos, duration, rate, timing)
    random = generator(random_state)
    roots, weights = np.linalg.cholesky(covariances), minimum_jerk(via_points)
    times, positions = [], []
    for _ in range(n_demos):
        time, phase = paced(duration, rate, timing, random)
        passed = via_points + np.einsum("kij,kj->ki", roots, random.normal(size=via_points.shape))
        tremor = np.stack([band_noise(time, 0.0, 2.0, random) for _ in range(2)], axis=1)
        times.append(time)
        positions.append(weights(phase) @ passed + _TREMOR * tremor)
    return Demonstrations(times, positions, names=("x", "y"), units="m")


def paced(duration: float, rate: float, timing: float, random: Random) -> tuple[Floats, Floats]:
    """Times (T,) of a demonstration, and its phases: both its duration and its pace vary by ``timing``."""
    longer, pace = timing * random.normal(size=2)
    lasting = duration * np.exp(longer)
    time = np.arange(max(2, round(lasting * rate)) + 1) / rate
    # phase' = 1 + a cos(2 pi t / T) > 0: early slower and late faster, or the reverse, with the same ends.
    even = time / time[-1]
    phase = even + np.tanh(2.0 * pace) * np.sin(2.0 * np.pi * even) / (2.0 * np.pi)
    return time, phase.clip(0.0, 1.0)


def _via_law(shape: Shape, via_precision: ArrayLike | None) -> tuple[Floats, Floats]:
    """Means (k, 2) of the via points of a letter, in m, and their covariances (k, 2, 2)."""
    checks.choice(shape, "shape", Shape)
    table = np.array(_VIA_POINTS[shape], dtype=np.float64)
    means, across = 1e-2 * table[:, :2], 1e-3 * table[:, 2]
    if via_precision is not None:
        given = checks.real_floats(via_precision, "via_precision")
        given = np.broadcast_to(given, len(means)) if given.ndim == 0 else given
        across = checks.array(given, "via_precision", (len(means),))
        checks.require(across > 0.0, across, "via_precision", "above zero", "a standard deviation in m")
    # The direction of the path is that of the chord between the neighbours.
    chord = np.gradient(means, axis=0)
    tangent = chord / np.linalg.norm(chord, axis=1, keepdims=True)
    normal = tangent[:, ::-1] * [-1.0, 1.0]
    outer = [np.einsum("ki,kj->kij", axis, axis) for axis in (tangent, normal)]
    return means, across[:, np.newaxis, np.newaxis] ** 2 * (_ALONG**2 * outer[0] + outer[1])


def minimum_jerk(via_points: Floats) -> BSpline:
    """Weights (n, k) of the via points over phases (n,), in the movement of least jerk from rest to rest."""
    # Passed at phases by the square root of the distance: slower in narrow turns, as hands are.
    passes = np.append(0.0, np.linalg.norm(np.diff(via_points, axis=0), axis=1) ** 0.5).cumsum()
    rest = [(order, np.zeros(len(via_points))) for order in (1, 2)]
    return make_interp_spline(passes / passes[-1], np.eye(len(via_points)), k=5, bc_type=(rest, rest))


def phases(phase: ArrayLike) -> Floats:
    """Phases (n,) from 0 to 1 of what was given as (n,) or (n, 1)."""
    at = column(phase, "phase")
    checks.require((at >= 0.0) & (at <= 1.0), at, "phase", "from 0 to 1")
    return at
