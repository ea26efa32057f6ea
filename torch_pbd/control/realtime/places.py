"""Positions and poses in plain floats: differences, moves and speeds of the real-time controller.

A place is a position of p floats, or a pose: those, and a unit quaternion w x y z. Moves, velocities and forces have p
components, and for poses three of a rotation besides, in world axes.
"""

import math
from collections.abc import Callable, Sequence
from operator import add, sub

Vector = tuple[float, ...]
Norm = Callable[[Sequence[float]], float]


def deviation(place: Sequence[float], goal: Sequence[float], d: int) -> Vector:
    """Move of d components that leads from a goal to a place: x - x_d, and the rotation vector Log(R R_d').

    It takes the shorter way round, and is blind to the lengths and signs of quaternions.
    """
    if len(place) == d:
        return tuple(map(sub, place, goal))
    w, x, y, z = place[-4:]
    a, b, c, e = goal[-4:]
    cos = w * a + x * b + y * c + z * e
    sin_x = x * a - w * b - y * e + z * c
    sin_y = y * a - w * c - z * b + x * e
    sin_z = z * a - w * e - x * c + y * b
    sin = math.hypot(sin_x, sin_y, sin_z)
    # Of two quaternions of a rotation the one with cos >= 0 turns by pi at most.
    share = math.copysign(2.0 * math.atan2(sin, abs(cos)) / sin, cos) if sin else 0.0
    return (*map(sub, place[:-4], goal[:-4]), share * sin_x, share * sin_y, share * sin_z)


def moved(place: Sequence[float], move: Sequence[float]) -> Vector:
    """Place that a move leads to: x + dx, and Exp(dr) R, a unit quaternion again."""
    if len(place) == len(move):
        return tuple(map(add, place, move))
    x, y, z = move[-3:]
    angle = math.hypot(x, y, z)
    a, share = math.cos(0.5 * angle), math.sin(0.5 * angle) / angle if angle else 0.0
    b, c, d = share * x, share * y, share * z
    w, x, y, z = place[-4:]
    turned = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    length = math.hypot(*turned)
    return (*map(add, place, move[:-3]), *[part / length for part in turned])


def rotated(vector: Sequence[float], rotation: Sequence[float]) -> Vector:
    """Vector of three that is turned by a rotation vector; O. Rodrigues, 1840."""
    angle = math.hypot(*rotation)
    if not angle:
        return tuple(vector)
    along = math.sin(angle) / angle
    # 1 - cos t, without its cancellation.
    across = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    once = _cross(rotation, vector)
    return tuple([v + along * u + across * w for v, u, w in zip(vector, once, _cross(rotation, once), strict=True)])


def norm_with(lever: float | None) -> Norm:
    """Norm of velocities: their length, or with a lever that of their positions or lever times that of the rotation.

    The lever, in units/rad, says which speeds of the two count as equally fast; the larger one counts.
    """
    if lever is None:
        return lambda vector: math.hypot(*vector)
    return lambda twist: max(math.hypot(*twist[:-3]), lever * math.hypot(*twist[-3:]))


def _cross(left: Sequence[float], right: Sequence[float]) -> Vector:
    (a, b, c), (x, y, z) = left, right
    return b * z - c * y, c * x - a * z, a * y - b * x
