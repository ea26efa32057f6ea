"""Synthetic minimum-jerk movements through via points with a known law: handwriting and peg in hole."""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.poses import QUATERNION
from torch_pbd.data.synthetic import Random, Seed, band_noise, check_recording, column, generator
from torch_pbd.rotations import exp, matrix, multiply

Shape = Literal["C", "G", "J", "S", "W", "Z"]

# Via points of each letter, 10 cm high: x and y in cm, and standard deviation across the path in mm.
_LETTERS = {
    "C": [(7, 8.4, 2), (3.5, 10, 6), (0.2, 5, 9), (3.5, 0, 6), (7, 1.6, 1)],
    "G": [(7, 8.6, 2), (3.5, 10, 6), (0.1, 5, 9), (3.5, 0, 5), (7, 2, 3), (6.9, 4.4, 1), (4.2, 4.5, 1)],
    "J": [(5.5, 10, 1), (5.5, 6.5, 6), (5.4, 3, 8), (3.2, 0, 4), (0.4, 2.4, 1)],
    "S": [(6.6, 8.6, 3), (3.5, 10, 8), (0.5, 7.6, 7), (3.5, 5.1, 1), (6.6, 2.5, 6), (3.4, 0, 8), (0.2, 1.4, 1)],
    "W": [(0, 10, 4), (2.3, 0, 1), (4.6, 8, 8), (6.9, 0, 1), (9.2, 10, 4)],
    "Z": [(0, 10, 1), (3.5, 10.1, 6), (7, 10, 1), (3.5, 5, 9), (0, 0, 1), (3.5, -0.1, 6), (7, 0, 1)],
}
_ALONG = 0.5  # ratio of the deviation along the path to that across it
_TREMOR = 2e-4  # rms in m of tremor up to 2 Hz, so that no output is ever constant

_HOLE = np.array([0.55, 0.15, 0.18])  # bottom of the hole in the frame of a robot's base, in m
# Orientation of the tool in the hole: z axis down, then leaning by 0.35 rad, so that no task axis is a world axis.
_TURN = multiply(exp(np.array([0.3, 0.18, 0.0])), exp(np.array([np.pi, 0.0, 0.0])))

# Via points: place and rotation vector against the hole, in m and rad, in the axes of the tool that is in it; standard
# deviations across and along its z axis in mm, about these axes in degrees. The last row is common to all of them: the
# peg is round, and however a hand holds it about z it goes on with.
_PEG = np.array(
    [
        (-0.20, 0.36, -0.30, 0.7, -0.5, 1.0, 25, 25, 10, 8),
        (-0.13, 0.20, -0.26, 0.5, -0.2, 0.6, 35, 35, 12, 8),
        (0.0, 0.0, -0.09, 0.1, 0.0, 0.1, 8, 12, 4, 3),
        (0.0, 0.0, -0.03, 0.0, 0.0, 0.0, 1.0, 10, 1.0, 1),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 8, 0.7, 1),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0, 20),
    ]
)
_PEG_MEANS = _PEG[:-1, :6]
# In m and rad, for each of the six outputs.
_PEG_DEVIATIONS = (_PEG[:, 6:] * [1e-3, 1e-3, np.pi / 180.0, np.pi / 180.0])[:, [0, 0, 1, 2, 2, 3]]
_POSE_TREMOR = np.repeat([2e-4, 2e-3], 3)  # rms in m and rad of tremor up to 2 Hz


def handwriting_mean(phase: ArrayLike, shape: Shape = "S") -> Floats:
    """Mean (n, 2) of a letter in m, at phases (n,) or (n, 1) from 0, its start, to 1, its end."""
    via_points, _ = _via_law(shape, None)
    return _weights(phase, via_points) @ via_points


def handwriting_covariance(phase: ArrayLike, shape: Shape = "S", *, via_precision: ArrayLike | None = None) -> Floats:
    """Covariance (n, 2, 2) over demonstrations of a letter in m^2, at phases (n,) or (n, 1) from 0 to 1.

    ``via_precision`` is the parameter of `make_handwriting_demonstrations`.
    """
    via_points, covariances = _via_law(shape, via_precision)
    # A movement is linear in its via points, which are independent: x = sum_k b_k p_k, so C = sum_k b_k^2 C_k.
    return np.einsum("nk,kij->nij", _weights(phase, via_points) ** 2, covariances) + _TREMOR**2 * np.eye(2)


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
    """Demonstrations, x and y in m, of a written letter: minimum-jerk movements through randomly perturbed via points.

    Each movement starts and ends at rest and has the least jerk of those that pass its via points at their phases
    (T. Flash, N. Hogan, Journal of Neuroscience 5, 1985): the quintic spline through them. Via points are normal and
    independent, with the standard deviation ``via_precision`` across the path and half of it along the path. A tremor
    of 0.2 mm rms up to 2 Hz is added. `handwriting_mean` and `handwriting_covariance` give the exact law over phase.

    Parameters
    ----------
    shape : {"C", "G", "J", "S", "W", "Z"}, default="S"
        Letters 10 cm high, of five to seven via points.
    n_demos : int, default=6
    duration, rate : float, default=2.0 and 100.0
        Median duration in s, and sampling rate in Hz.
    via_precision : float or array_like of shape (n_via_points,), default=None
        Standard deviation in m across the path at each via point, or at all of them. None takes the letter's own, from
        1 mm where it is written precisely to 9 mm where it is free.
    timing : float, default=0.1
        Relative standard deviation of durations and of the pace within a demonstration, below 0.5. With 0 all
        demonstrations share one grid, and time / duration is the phase of the truth.
    random_state : int, Generator, RandomState or None, default=None
    """
    via_points, covariances = _via_law(shape, via_precision)
    roots = np.linalg.cholesky(covariances)
    times, positions = [], []
    for time, phase, random in _paces(n_demos, duration, rate, timing, random_state):
        passed = via_points + np.einsum("kij,kj->ki", roots, random.normal(size=via_points.shape))
        tremor = np.stack([band_noise(time, 0.0, 2.0, random) for _ in range(2)], axis=1)
        times.append(time)
        positions.append(_weights(phase, via_points) @ passed + _TREMOR * tremor)
    return Demonstrations(times, positions, names=("x", "y"), units="m")


def pose_mean(phase: ArrayLike) -> tuple[Floats, Floats]:
    """Mean positions (n, 3) in m and rotations (n, 4) as quaternions w x y z, at phases (n,) or (n, 1) from 0 to 1."""
    place = _weights(phase, _PEG_MEANS[:, :3]) @ _PEG_MEANS
    return _HOLE + place[:, :3] @ matrix(_TURN).T, multiply(_TURN, exp(place[:, 3:]))


def pose_covariance(phase: ArrayLike) -> Floats:
    """Covariance (n, 6, 6) of poses over demonstrations, at phases (n,) or (n, 1) from 0 to 1, in m^2, m rad, rad^2.

    It is the covariance of ``(x - x_d, Log(R R_d'))`` at the mean pose in world axes, as in schedules.
    """
    # Deviations are linear in those of the via points, which are independent, as in handwriting_covariance.
    *own, common = _PEG_DEVIATIONS**2
    variances = _weights(phase, _PEG_MEANS[:, :3]) ** 2 @ np.array(own) + common + _POSE_TREMOR**2
    turned = matrix(_TURN), matrix(pose_mean(phase)[1])
    covariance = np.zeros((len(variances), 6, 6))
    for block, turn in zip((slice(3), slice(3, 6)), turned, strict=True):
        covariance[:, block, block] = turn @ (variances[:, block, np.newaxis] * np.swapaxes(turn, -1, -2))
    return covariance


def make_pose_demonstrations(
    n_demos: int = 8,
    duration: float = 4.0,
    rate: float = 100.0,
    *,
    timing: float = 0.1,
    random_state: Seed = None,
) -> Demonstrations:
    """Demonstrations, x, y, z in m and rx, ry, rz in rad, of a peg that is moved, turned and inserted into a hole.

    Position and rotation are minimum-jerk movements through five via points, as in `make_handwriting_demonstrations`,
    in the workspace of an arm of 0.8 m whose base is the origin; the tool turns by 76 degrees. On the way the hand is
    free. In the hole, which leans by 20 degrees, the peg is precise across (0.7 mm, 0.7 degrees about two axes), and
    free along (8 mm) and about its own axis (20 degrees). `pose_mean` and `pose_covariance` are the law.

    Parameters
    ----------
    n_demos : int, default=8
        Number of demonstrations; six or fewer cannot determine a covariance of six outputs.
    duration, rate, timing, random_state
        Parameters of `make_handwriting_demonstrations`, in s and Hz.
    """
    times, positions = [], []
    for time, phase, random in _paces(n_demos, duration, rate, timing, random_state):
        place, turn = pose_mean(phase)
        tremor = np.stack([band_noise(time, 0.0, 2.0, random) for _ in range(6)], axis=1)
        *own, common = _PEG_DEVIATIONS * random.normal(size=_PEG_DEVIATIONS.shape)
        deviation = _weights(phase, _PEG_MEANS[:, :3]) @ np.array(own) + common + _POSE_TREMOR * tremor
        times.append(time)
        # In the axes of the tool: R = R_d Exp(deviation).
        positions.append(np.hstack([place + deviation[:, :3] @ matrix(_TURN).T, multiply(turn, exp(deviation[:, 3:]))]))
    return Demonstrations(times, positions, names=("x", "y", "z", *QUATERNION), units="m", rotation=QUATERNION)


def _via_law(shape: Shape, via_precision: ArrayLike | None) -> tuple[Floats, Floats]:
    """Means (k, 2) of the via points of a letter, in m, and their covariances (k, 2, 2)."""
    checks.choice(shape, "shape", Shape)
    table = np.array(_LETTERS[shape], dtype=np.float64)
    means, across = 1e-2 * table[:, :2], 1e-3 * table[:, 2]
    if via_precision is not None:
        one = np.ndim(via_precision) == 0
        given = np.full(len(means), via_precision) if one else via_precision
        across = checks.array(given, "via_precision", (len(means),))
        checks.require(across > 0.0, across, "via_precision", "above zero", "a standard deviation in m")
    # The direction of the path is that of the chord between the neighbours. Across it is t t' off the identity.
    chord = np.gradient(means, axis=0)
    tangent = chord / np.linalg.norm(chord, axis=1, keepdims=True)
    along = np.einsum("ki,kj->kij", tangent, tangent)
    return means, across[:, np.newaxis, np.newaxis] ** 2 * (_ALONG**2 * along + (np.eye(2) - along))


def _paces(
    n_demos: int, duration: float, rate: float, timing: float, random_state: Seed
) -> Iterator[tuple[Floats, Floats, Random]]:
    """Times (T,) and phases of demonstrations whose duration and pace vary by ``timing``, and the generator."""
    check_recording(n_demos, duration, rate, timing)
    random = generator(random_state)
    for _ in range(n_demos):
        longer, pace = timing * random.normal(size=2)
        time = np.arange(max(2, round(duration * np.exp(longer) * rate)) + 1) / rate
        # phase' = 1 + a cos(2 pi t / T) > 0: early slower and late faster, or the reverse, with the same ends.
        even = time / time[-1]
        phase = even + np.tanh(2.0 * pace) * np.sin(2.0 * np.pi * even) / (2.0 * np.pi)
        yield time, phase.clip(0.0, 1.0), random


def _weights(phase: ArrayLike, via_points: Floats) -> Floats:
    """Weights (n, k) of via points at phases (n,) or (n, 1) from 0 to 1, in the least jerk from rest to rest."""
    at = column(phase, "phase")
    checks.require((at >= 0.0) & (at <= 1.0), at, "phase", "from 0 to 1")
    # Phases advance by the square root of the distance: slower in narrow turns, as hands are.
    passes = np.append(0.0, np.linalg.norm(np.diff(via_points, axis=0), axis=1) ** 0.5).cumsum()
    rest = [(order, np.zeros(len(via_points))) for order in (1, 2)]
    spline = make_interp_spline(passes / passes[-1], np.eye(len(via_points)), k=5, bc_type=(rest, rest))
    return np.asarray(spline(at))
