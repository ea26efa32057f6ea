"""Rotations as unit quaternions w x y z, and the chart in which they are learned as three numbers.

Quaternions (..., 4) turn vectors of the body, a tool, into vectors of the world; rotation vectors (..., 3) are in rad.
NumPy alone is imported, for schedules and the control loop: tests compare it with ``scipy.spatial.transform``, which
has the same. `multiply`, `exp`, `between`, `cross_matrix` and `of_last_axes` take torch's tensors too, from the
simulated robot.
"""

import math
import sys
from typing import Any, final

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats

Array = Any
"""An array of NumPy, or a tensor."""

# Coefficients of a rotation vector v of length t. Where a difference cancels, its error is relative to what the term of
# v that it belongs to leaves of it, so that only t = 0 itself needs care: below these, the next term is below 1e-16.
_TINY, _SMALL = 1e-4, 1e-3
_MAX_STEPS = 100


def library_of(array: Array) -> Any:
    """NumPy or torch, by the type of the array."""
    return sys.modules[type(array).__module__.partition(".")[0]]


def multiply(first: Array, second: Array) -> Array:
    """Product of quaternions: the rotation by ``second``, then by ``first``."""
    (a0, a1, a2, a3), (b0, b1, b2, b3) = ([each[..., i] for i in range(4)] for each in (first, second))
    product = [
        a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
        a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
        a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
        a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
    ]
    return library_of(first).stack(product, -1)


def conjugate(quaternion: Array) -> Array:
    """Inverse rotation."""
    return library_of(quaternion).concatenate([quaternion[..., :1], -quaternion[..., 1:]], axis=-1)


def exp(vector: Array) -> Array:
    """Quaternion (..., 4) of a rotation vector (..., 3)."""
    library = library_of(vector)
    half = 0.5 * library.linalg.norm(vector, axis=-1, keepdims=True)
    return library.concatenate([library.cos(half), 0.5 * library.sinc(half / math.pi) * vector], axis=-1)


def log(quaternion: Floats) -> Floats:
    """Rotation vector (..., 3) of a quaternion (..., 4), the shorter way: at most pi long."""
    shorter = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    return _vector(shorter[..., :1], shorter[..., 1:])


def between(start: Array, end: Array) -> Array:
    """Rotation vector (..., 3) in world axes from one quaternion (..., 4) to another, the shorter way."""
    library = library_of(end)
    nearer = library.where((end * start).sum(-1)[..., None] < 0.0, -end, end)
    # The difference keeps the digits of small rotations: q2 q1' = 1 + (q2 - q1) q1'.
    away = multiply(nearer - start, conjugate(start))
    return _vector(1.0 + away[..., :1], away[..., 1:])


def _vector(w: Array, xyz: Array) -> Array:
    """Rotation vector (..., 3) of a quaternion with w >= 0."""
    library = library_of(xyz)
    length = library.linalg.norm(xyz, axis=-1, keepdims=True)
    tiny = length < library.finfo(length.dtype).tiny
    return library.where(tiny, 2.0, 2.0 * library.arctan2(length, w) / library.where(tiny, 1.0, length)) * xyz


def matrix(quaternion: Floats) -> Floats:
    """Rotation matrix (..., 3, 3) of a quaternion (..., 4)."""
    w, v = quaternion[..., :1, np.newaxis], quaternion[..., 1:]
    turned = 2.0 * (v[..., :, np.newaxis] * v[..., np.newaxis, :] + w * cross_matrix(v))
    return turned + (2.0 * w * w - 1.0) * np.eye(3)


def from_matrix(rotation: Floats) -> Floats:
    """Quaternion (..., 4) with w >= 0 of a rotation matrix (..., 3, 3).

    4 q q' - 1 is linear in the matrix, and q its eigenvector (I. Y. Bar-Itzhack, "New method for extracting the
    quaternion from a rotation matrix", Journal of Guidance, Control, and Dynamics 23, 2000).
    """
    trace = np.trace(rotation, axis1=-2, axis2=-1)[..., np.newaxis, np.newaxis]
    outer = np.empty((*rotation.shape[:-2], 4, 4))
    outer[..., :1, :1], outer[..., 1:, 1:] = trace, rotation + rotation.mT - trace * np.eye(3)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = rotation[..., k, j] - rotation[..., j, k]
    quaternion = np.linalg.eigh(outer)[1][..., -1]
    return np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)


def cross_matrix(vector: Array) -> Array:
    """Matrix (..., 3, 3) of the cross product with a vector (..., 3) from the left."""
    x, y, z = (vector[..., i] for i in range(3))
    zero = 0.0 * x
    return library_of(vector).stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)


def of_last_axes(matrix: Array, d: int) -> Array:
    """Matrix (..., d, d) that acts as one (..., 3, 3) on the last three of d components, and leaves the others."""
    library = library_of(matrix)
    whole = library.zeros((*matrix.shape[:-2], d, d), dtype=matrix.dtype, device=matrix.device)
    whole[..., : d - 3, : d - 3] = library.eye(d - 3)
    whole[..., d - 3 :, d - 3 :] = matrix
    return whole


def left_jacobian(vector: Floats) -> Floats:
    """Matrix (..., 3, 3) from the rate of a rotation vector to the angular velocity in world axes, of -v in body axes.

    ``I + b [v] + c [v]^2`` with ``b = (1 - cos t) / t^2``, ``c = (t - sin t) / t^3``; F. Bullo, R. M. Murray,
    "Proportional derivative (PD) control on the Euclidean group", ECC 1995.
    """
    b, c = (value[..., np.newaxis, np.newaxis] for value in _coefficients(vector)[:2])
    cross = cross_matrix(vector)
    return np.eye(3) + b * cross + c * cross @ cross


def continuous(quaternion: Floats) -> Floats:
    """Quaternions (n, ..., 4) with signs that make each the nearer one to that before it."""
    turns = np.sum(quaternion[1:] * quaternion[:-1], axis=-1) < 0.0
    signs = np.cumprod(np.where(turns, -1.0, 1.0), axis=0)
    return np.concatenate([quaternion[:1], signs[..., np.newaxis] * quaternion[1:]])


def mean(quaternion: Floats) -> Floats:
    """Rotation (4,), with w >= 0, that has the least sum of squared angles to those given (n, 4): the Frechet mean.

    Karcher's iteration from the mean in the chordal metric, an eigenvector that is blind to signs.
    """
    found = np.linalg.eigh(quaternion.T @ quaternion)[1][:, -1]
    for _ in range(_MAX_STEPS):
        step = log(multiply(conjugate(found), quaternion)).mean(axis=0)
        found = multiply(found, exp(step))
        found /= np.linalg.norm(found)
        if float(np.linalg.norm(step)) < 1e-15:
            break
    return -found if found[0] < 0.0 else found


@final
class Chart:
    """Rotations as three numbers y = Log(R0' R) around a reference R0: R = R0 Exp(y).

    Parameters
    ----------
    reference : array_like of shape (4,)
        R0, a unit quaternion w x y z.
    """

    def __init__(self, reference: Floats) -> None:
        self.reference = checks.array(reference, "reference", (4,))
        self._turn = matrix(self.reference)

    def log(self, quaternion: Floats) -> Floats:
        """Coordinates y (..., 3) of quaternions (..., 4), in rad."""
        return log(multiply(conjugate(self.reference), quaternion))

    def exp(self, coordinates: Floats) -> Floats:
        """Quaternions (..., 4) at coordinates y (..., 3)."""
        return multiply(self.reference, exp(coordinates))

    def to_world(self, coordinates: Floats) -> Floats:
        """Matrix (..., 3, 3) from small changes of y, at y, to rotation vectors in world axes: ``R0 Jl(y) = R Jr(y)``.

        Covariances of y become those in world axes by it, from both sides.
        """
        return self._turn @ left_jacobian(coordinates)

    def velocity(self, coordinates: Floats, rate: Floats) -> Floats:
        """Angular velocity (..., 3) in world axes, rad/s, of y that changes at a rate (..., 3)."""
        return (self.to_world(coordinates) @ rate[..., np.newaxis])[..., 0]

    def acceleration(self, coordinates: Floats, rate: Floats, second: Floats) -> Floats:
        """Angular acceleration (..., 3) in world axes, rad/s^2: ``R0 (Jl y'' + Jl' y')``."""
        c, slope_b, slope_c = (value[..., np.newaxis] for value in _coefficients(coordinates)[1:])
        # (Jl)' y' = b' v x y' + c' v x (v x y') + c y' x (v x y'), and b' is its slope by t, over t, times v'y'.
        along = np.sum(coordinates * rate, axis=-1, keepdims=True)
        normal = np.cross(coordinates, rate)
        turning = (
            slope_b * along * normal + slope_c * along * np.cross(coordinates, normal) + c * np.cross(rate, normal)
        )
        return self.velocity(coordinates, second) + turning @ self._turn.T


def _coefficients(vector: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Coefficients b and c of the left Jacobian (...), and their slopes by t, over t."""
    angle = np.linalg.norm(vector, axis=-1)
    t, short = np.where(angle < _SMALL, 1.0, angle), angle < _SMALL
    b = 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    c = np.where(angle < _TINY, 1.0 / 6.0, (angle - np.sin(angle)) / np.where(angle < _TINY, 1.0, angle) ** 3)
    slope_b = np.where(short, -1.0 / 12.0 + angle**2 / 180.0, (np.sin(t) - 2.0 * t * b) / t**3)
    slope_c = np.where(short, -1.0 / 60.0 + angle**2 / 1260.0, (b - 3.0 * c) / t**2)
    return b, c, slope_b, slope_c
