"""One tick of the real-time controller, solved exactly: with floats where axes are shared, else with NumPy."""

import math
from collections.abc import Sequence
from operator import mul, sub

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats

Numbers = Sequence[float] | Floats
Vector = tuple[float, ...]
State = tuple[Vector, Vector]
"""Position and velocity."""

# Of (w h)^2, w the frequency of an axis and h the step: below, two terms of a series in it have all digits.
_CRITICAL = 1e-7
# Of a h, a half the damping: below, five terms have.
_SHORT = 0.01


def advance_plane(row: Vector, push: Vector, state: State, step: float, pull_limit: float) -> tuple[State, float]:
    """`advance_modal` for d = 2, written out."""
    goal_x, goal_y, goal_vx, goal_vy, top, stiff_1, stiff_2, decay_1, decay_2, cos, sin, _, _ = row
    ((x, y), (vx, vy)), (push_x, push_y) = state, push
    off_x, off_y = x - goal_x, y - goal_y
    off_1, off_2 = cos * off_x + sin * off_y, cos * off_y - sin * off_x
    v_1, v_2 = cos * vx + sin * vy, cos * vy - sin * vx
    scale, pull = 1.0, top * (stiff_1 * off_1 * off_1 + stiff_2 * off_2 * off_2)
    if pull > pull_limit * pull_limit:
        scale = pull_limit / math.sqrt(pull)
        stiff_1, stiff_2 = scale * stiff_1, scale * stiff_2
    q_1 = cos * push_x + sin * push_y + 2.0 * decay_1 * (cos * goal_vx + sin * goal_vy) - stiff_1 * off_1
    q_2 = cos * push_y - sin * push_x + 2.0 * decay_2 * (cos * goal_vy - sin * goal_vx) - stiff_2 * off_2
    s_1, p_1 = _responses(stiff_1, decay_1, step)
    s_2, p_2 = _responses(stiff_2, decay_2, step)
    dx_1, dx_2 = s_1 * v_1 + p_1 * q_1, s_2 * v_2 + p_2 * q_2
    dv_1 = s_1 * q_1 - (2.0 * decay_1 * s_1 + stiff_1 * p_1) * v_1
    dv_2 = s_2 * q_2 - (2.0 * decay_2 * s_2 + stiff_2 * p_2) * v_2
    there = (x + cos * dx_1 - sin * dx_2, y + sin * dx_1 + cos * dx_2)
    return (there, (vx + cos * dv_1 - sin * dv_2, vy + sin * dv_1 + cos * dv_2)), scale


def advance_modal(row: Vector, push: Vector, state: State, step: float, pull_limit: float) -> tuple[State, float]:
    """Position and velocity after ``step`` s, and the scale of the stiffness; each axis by itself.

    Along an axis, y = x - x_d follows y'' + 2 a y' + k y = f + 2 a v_d, all per kg. With the responses S and P of
    `_responses` and q = f + 2 a v_d - k y, y grows by S v + P q and v by S q - (2 a S + k P) v: increments, which
    keep their digits in short ticks.
    """
    (position, velocity), d = state, len(push)
    stiffness, decay = row[2 * d + 1 : 3 * d + 1], row[3 * d + 1 : 4 * d + 1]
    axes = [row[start : start + d] for start in range(4 * d + 1, len(row), d)]
    off = tuple(map(sub, position, row))
    off_axes = [_dot(axis, off) for axis in axes]
    pull = row[2 * d] * sum(k * y * y for k, y in zip(stiffness, off_axes, strict=True))
    scale = pull_limit / math.sqrt(pull) if pull > pull_limit * pull_limit else 1.0
    there, faster = list(position), list(velocity)
    for axis, k, a, y in zip(axes, stiffness, decay, off_axes, strict=True):
        s, p = _responses(scale * k, a, step)
        v = _dot(axis, velocity)
        q = _dot(axis, push) + 2.0 * a * _dot(axis, row[d : 2 * d]) - scale * k * y
        dx, dv = s * v + p * q, s * q - (2.0 * a * s + scale * k * p) * v
        for i, share in enumerate(axis):
            there[i] += dx * share
            faster[i] += dv * share
    return (tuple(there), tuple(faster)), scale


def advance_coupled(row: Vector, push: Vector, state: State, step: float, pull_limit: float) -> tuple[State, float]:
    """As `advance_modal` for matrices that share no axes: exp(X) - 1 of the whole system, time in ticks."""
    (position, velocity), d = state, len(push)
    goal, goal_velocity, (top,), gains = np.split(np.array(row), [d, 2 * d, 2 * d + 1])
    stiffness, damping = gains.reshape(2, d, d)
    off = np.subtract(position, goal)
    pull = top * (off @ stiffness @ off)
    scale = pull_limit / math.sqrt(pull) if pull > pull_limit * pull_limit else 1.0
    rate = np.zeros((2 * d + 1, 2 * d + 1))
    rate[:d, d:-1] = np.eye(d)
    rate[d:-1, :d], rate[d:-1, d:-1] = -(step**2) * scale * stiffness, -step * damping
    rate[d:-1, -1] = step**2 * (push + damping @ goal_velocity)
    change = _expm1(rate) @ np.concatenate([off, np.multiply(step, velocity), [1.0]])
    there, faster = np.add(position, change[:d]), np.add(velocity, change[d:-1] / step)
    return (tuple(there.tolist()), tuple(faster.tolist())), scale


def _expm1(matrix: Floats) -> Floats:
    """exp(matrix) - 1 by Taylor series and doubling: without the 1, slow motions keep their digits beside fast ones."""
    doublings = max(0, math.frexp(np.abs(matrix).sum(axis=1).max())[1] + 1)
    # The norm is now 1/2 at most, for which 14 terms have all digits.
    small = matrix / 2.0**doublings
    power = small / 14.0
    for order in range(13, 0, -1):
        power = (small + small @ power) / order
    for _ in range(doublings):
        power = 2.0 * power + power @ power
    return power


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


def vector(values: Numbers, name: str, d: int) -> Vector:
    """Finite floats, one for each of d axes."""
    return tuple(checks.array(values, name, (d,)).tolist())


def minimum_jerk(phase: float) -> tuple[float, float]:
    """Rest of a way of 1 by minimum jerk at a phase of 0..1, and its slope over the phase."""
    return 1.0 - phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2), -30.0 * phase**2 * (1.0 - phase) ** 2


def braked(state: State, deceleration: float, step: float) -> State:
    """Position and velocity after braking for ``step`` s, or until standing still."""
    position, velocity = state
    speed = math.hypot(*velocity)
    braking = min(step, speed / deceleration)
    left = 1.0 - deceleration * step / speed if braking == step else 0.0
    slower = tuple(left * component for component in velocity)
    return drift(position, velocity, slower, braking), slower


def drift(position: Vector, before: Vector, after: Vector, time: float) -> Vector:
    """Position after a time in which the velocity changes evenly."""
    return tuple(x + 0.5 * time * (v + w) for x, v, w in zip(position, before, after, strict=True))


def _dot(left: Vector, right: Vector) -> float:
    return sum(map(mul, left, right))
