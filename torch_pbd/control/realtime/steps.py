"""Arithmetic of a tick in plain floats: places and moves, and the motion of eq. (15) over a tick, solved exactly.

A place is a position of p floats, or a pose: those, and a unit quaternion w x y z. Moves, velocities and forces have p
components, and for poses three of a rotation besides, in world axes.
"""

import math
from collections.abc import Sequence
from operator import add, mul, sub

import numpy as np

from torch_pbd.checks import Floats
from torch_pbd.control.filters import expm1

Vector = tuple[float, ...]
State = tuple[Vector, Vector]
"""Place and velocity."""

# Bound of (w h)^2, w the frequency of an axis and h the step, below which two terms of its series are exact.
_CRITICAL = 1e-7
# Bound of a h, a half the damping, below which five terms of its series are exact.
_SHORT = 0.01


def deviation(place: Sequence[float], goal: Sequence[float], d: int) -> Vector:
    """Move of d components from a goal to a place: x - x_d, and the rotation vector Log(R R_d').

    It takes the shorter way round, and does not depend on the lengths and signs of quaternions.
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
    # The quaternion of a rotation with cos >= 0 turns by at most pi.
    share = math.copysign(2.0 * math.atan2(sin, abs(cos)) / sin, cos) if sin else 0.0
    return (*map(sub, place[:-4], goal[:-4]), share * sin_x, share * sin_y, share * sin_z)


def moved(place: Sequence[float], move: Sequence[float]) -> Vector:
    """Place after a move: x + dx, and Exp(dr) R as a unit quaternion."""
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


def mean_move(before: Vector, after: Vector, time: float) -> Vector:
    """Move over a time in which the velocity changes linearly."""
    return tuple([0.5 * time * (v + w) for v, w in zip(before, after, strict=True)])


def advance_plane(row: Vector, push: Vector, state: State, step: float) -> tuple[State, float]:
    """Place and velocity after ``step`` s, and the scale of the stiffness: `along_modes` for d = 2, written out.

    The row begins with the desired motion; its axes are those of one mass in all directions.
    """
    goal_x, goal_y, goal_vx, goal_vy, top, stiff_1, stiff_2, decay_1, decay_2, cos, sin, mass = row
    ((x, y), (vx, vy)), (push_x, push_y) = state, push
    off_x, off_y = x - goal_x, y - goal_y
    off_1, off_2 = cos * off_x + sin * off_y, cos * off_y - sin * off_x
    v_1, v_2 = cos * vx + sin * vy, cos * vy - sin * vx
    scale, pull = 1.0, top * mass * (stiff_1 * off_1 * off_1 + stiff_2 * off_2 * off_2)
    if pull > 1.0:
        scale = 1.0 / math.sqrt(pull)
        stiff_1, stiff_2 = scale * stiff_1, scale * stiff_2
    f_1, f_2 = (cos * push_x + sin * push_y) / mass, (cos * push_y - sin * push_x) / mass
    q_1 = f_1 + 2.0 * decay_1 * (cos * goal_vx + sin * goal_vy) - stiff_1 * off_1
    q_2 = f_2 + 2.0 * decay_2 * (cos * goal_vy - sin * goal_vx) - stiff_2 * off_2
    s_1, p_1 = _responses(stiff_1, decay_1, step)
    s_2, p_2 = _responses(stiff_2, decay_2, step)
    dx_1, dx_2 = s_1 * v_1 + p_1 * q_1, s_2 * v_2 + p_2 * q_2
    dv_1 = s_1 * q_1 - (2.0 * decay_1 * s_1 + stiff_1 * p_1) * v_1
    dv_2 = s_2 * q_2 - (2.0 * decay_2 * s_2 + stiff_2 * p_2) * v_2
    there = (x + cos * dx_1 - sin * dx_2, y + sin * dx_1 + cos * dx_2)
    return (there, (vx + cos * dv_1 - sin * dv_2, vy + sin * dv_1 + cos * dv_2)), scale


def along_modes(row: Vector, push: Vector, off: Vector, motion: State, step: float) -> tuple[Vector, Vector, float]:
    """Move and velocity after ``step`` s, and the scale of the stiffness, by independent modes.

    Modes, the columns of P, are such that P' M P = 1, while P' K P and P' D P are diagonal: with e = P y and f of a
    mode that of P' f, each y follows y'' + 2 a y' + k y = f + 2 a v_d. With the responses S and B of `_responses` and
    q = f + 2 a v_d - k y, y grows by S v + B q and v by S q - (2 a S + k B) v: increments, which keep their digits in
    short ticks.

    A row has the largest stiffness over the squared limit of the spring, k and a of each mode, the rows of P' M, which
    tell y from e, and those of P'. The motion is the desired velocity, and that of the robot.
    """
    (goal_velocity, velocity), d = motion, len(push)
    stiffness, decay = row[1 : d + 1], row[d + 1 : 2 * d + 1]
    maps = [row[start : start + d] for start in range(2 * d + 1, len(row), d)]
    tells, shapes = maps[:d], maps[d:]
    y = [_dot(tell, off) for tell in tells]
    pull = row[0] * sum([k * part * part for k, part in zip(stiffness, y, strict=True)])
    scale = 1.0 / math.sqrt(pull) if pull > 1.0 else 1.0
    move, faster = [0.0] * d, list(velocity)
    for tell, shape, k, a, part in zip(tells, shapes, stiffness, decay, y, strict=True):
        s, b = _responses(scale * k, a, step)
        v = _dot(tell, velocity)
        q = _dot(shape, push) + 2.0 * a * _dot(tell, goal_velocity) - scale * k * part
        dy, dv = s * v + b * q, s * q - (2.0 * a * s + scale * k * b) * v
        for i, share in enumerate(shape):
            move[i] += dy * share
            faster[i] += dv * share
    return tuple(move), tuple(faster), scale


def _dot(left: Vector, right: Vector) -> float:
    return sum(map(mul, left, right))


def coupled(
    stiffness: Floats, damping: Floats, mass: float | Floats, push: Vector, off: Vector, motion: State, step: float
) -> tuple[Vector, Vector]:
    """Move and velocity as `along_modes`, for gains without shared modes, by exp(X) - 1 of the whole system."""
    (goal_velocity, velocity), d = motion, len(push)
    held = (push + damping @ goal_velocity)[:, np.newaxis]
    rate = np.zeros((2 * d + 1, 2 * d + 1))
    rate[:d, d:-1] = np.eye(d)
    gains = np.concatenate([-(step**2) * stiffness, -step * damping, step**2 * held], axis=1)
    rate[d:-1] = gains / mass if isinstance(mass, float) else np.linalg.solve(mass, gains)
    change = expm1(rate) @ np.concatenate([off, np.multiply(step, velocity), [1.0]])
    return tuple(change[:d].tolist()), tuple(np.add(velocity, change[d:-1] / step).tolist())


def _responses(stiffness: float, decay: float, step: float) -> tuple[float, float]:
    """Impulse response S of y'' + 2 a y' + k y = 0 (y = 0, y' = 1 at first) after ``step`` s, and its integral P.

    They are written such that no exponential overflows and no difference of nearly equal numbers is left, near
    critical damping and k = 0 too.
    """
    lag = decay * step
    bend = stiffness * step * step - lag * lag
    if bend < -_CRITICAL:
        root = math.sqrt(-bend) / step
        fast = decay + root
        slow = stiffness / fast
        lost_fast, lost_slow = -math.expm1(-fast * step), -math.expm1(-slow * step)
        reach = lost_slow / slow if slow else step
        return 0.5 * (lost_fast - lost_slow) / root, 0.5 * (reach - lost_fast / fast) / root
    lost = -math.expm1(-lag)
    if bend > _CRITICAL:
        angle = math.sqrt(bend)
        impulse = (1.0 - lost) * math.sin(angle) * step / angle
        return impulse, (lost - decay * impulse + 2.0 * (1.0 - lost) * math.sin(0.5 * angle) ** 2) / stiffness
    impulse = (1.0 - lost) * step * (1.0 - bend / 6.0)
    if lag > _SHORT:
        return impulse, (lost - decay * impulse + 0.5 * bend * (1.0 - lost)) / stiffness
    series = 0.5 - lag * (1 / 3 - lag * (1 / 8 - lag * (1 / 30 - lag / 144))) - bend * (1 / 24 - lag / 30)
    return impulse, step * step * series
