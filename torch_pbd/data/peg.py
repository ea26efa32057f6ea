"""Poses of a tool whose law is known: a peg is brought over, turned, and put into a hole that leans."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline

from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.handwriting import minimum_jerk, paced, phases
from torch_pbd.data.poses import QUATERNION
from torch_pbd.data.synthetic import Seed, band_noise, check_recording, generator
from torch_pbd.rotations import exp, matrix, multiply

_HOLE = np.array([0.55, 0.15, 0.18])  # bottom of the hole in the frame of a robot's base, in m
# The tool in the hole: its z axis down, then leaning by 0.35 rad. No axis of the task is one of the world.
_TURN = multiply(exp(np.array([0.3, 0.18, 0.0])), exp(np.array([np.pi, 0.0, 0.0])))

# Via points: place and rotation vector against the hole, in m and rad, in the axes of the tool that is in it; standard
# deviations across and along its z axis in mm, about these axes in degrees. The last row is common to all of them: the
# peg is round, and however a hand holds it about z it goes on with.
_VIA_POINTS = np.array(
    [
        (-0.20, 0.36, -0.30, 0.7, -0.5, 1.0, 25, 25, 10, 8),
        (-0.13, 0.20, -0.26, 0.5, -0.2, 0.6, 35, 35, 12, 8),
        (0.0, 0.0, -0.09, 0.1, 0.0, 0.1, 8, 12, 4, 3),
        (0.0, 0.0, -0.03, 0.0, 0.0, 0.0, 1.0, 10, 1.0, 1),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 8, 0.7, 1),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0, 20),
    ]
)
_TREMOR = np.repeat([2e-4, 2e-3], 3)  # rms in m and rad, up to 2 Hz


def pose_mean(phase: ArrayLike) -> tuple[Floats, Floats]:
    """Mean positions (n, 3) in m and rotations (n, 4) as quaternions w x y z, at phases (n,) or (n, 1) from 0 to 1."""
    means, _, weights = _law()
    place = weights(phases(phase)) @ means
    return _HOLE + place[:, :3] @ matrix(_TURN).T, multiply(_TURN, exp(place[:, 3:]))


def pose_covariance(phase: ArrayLike) -> Floats:
    """Covariance (n, 6, 6) of poses over demonstrations, at phases (n,) or (n, 1) from 0 to 1, in m^2, m rad, rad^2.

    It is that of ``(x - x_d, Log(R R_d'))`` at the mean pose, in axes of the world, as schedules have it.
    """
    _, deviations, weights = _law()
    # Deviations are linear in those of the via points, which are independent, as in handwriting_covariance.
    variances = weights(phases(phase)) ** 2 @ deviations[:-1] ** 2 + deviations[-1] ** 2 + _TREMOR**2
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
    """A peg that is brought over, turned and put into a hole, several times.

    Position and rotation are minimum-jerk movements through five via points, as in `make_handwriting_demonstrations`,
    in the workspace of an arm of 0.8 m whose base is the origin; the tool turns by 76 degrees. On the way the hand is
    free. In the hole, which leans by 20 degrees, the peg is precise across (0.7 mm, 0.7 degrees about two axes), and
    free along (8 mm) and about its own axis (20 degrees).

    Parameters
    ----------
    n_demos : int, default=8
        Six and fewer leave open how six outputs vary together.
    duration : float, default=4.0
        In s; of each demonstration where ``timing`` is 0.
    rate : float, default=100.0
        Samples a second.
    timing : float, default=0.1
        Relative standard deviation of durations and of the pace within a demonstration, below 0.5. With 0 all
        demonstrations share one grid, and time / duration is the phase of the truth.
    random_state : int, Generator, RandomState or None, default=None

    Returns
    -------
    Demonstrations
        Outputs x, y, z in m and rx, ry, rz in rad; times in s.

    See Also
    --------
    pose_mean, pose_covariance : The law over the phase, exactly.

    Examples
    --------
    >>> from torch_pbd.data import make_pose_demonstrations
    >>> make_pose_demonstrations(timing=0.0, random_state=0)
    Demonstrations(n_demos=8, n_steps=401, outputs=('x', 'y', 'z', 'rx', 'ry', 'rz'), time_unit='s', aligned=True)
    """
    check_recording(n_demos, duration, rate, timing)
    random = generator(random_state)
    _, deviations, weights = _law()
    times, positions = [], []
    for _ in range(n_demos):
        time, phase = paced(duration, rate, timing, random)
        place, turn = pose_mean(phase)
        tremor = np.stack([band_noise(time, 0.0, 2.0, random) for _ in range(6)], axis=1)
        *own, common = deviations * random.normal(size=deviations.shape)
        deviation = weights(phase) @ np.array(own) + common + _TREMOR * tremor
        # In the axes of the tool: R = R_d Exp(deviation).
        poses = np.hstack([place + deviation[:, :3] @ matrix(_TURN).T, multiply(turn, exp(deviation[:, 3:]))])
        times.append(time)
        positions.append(poses)
    return Demonstrations(times, positions, names=("x", "y", "z", *QUATERNION), units="m", rotation=QUATERNION)


def _law() -> tuple[Floats, Floats, BSpline]:
    """Means (k, 6) and standard deviations (k + 1, 6) of via points in m and rad, and their weights over phases."""
    means, given = _VIA_POINTS[:, :6], _VIA_POINTS[:, 6:]
    units = np.array([1e-3, 1e-3, np.pi / 180.0, np.pi / 180.0])
    return means[:-1], (units * given)[:, [0, 0, 1, 2, 2, 3]], minimum_jerk(means[:-1, :3])
