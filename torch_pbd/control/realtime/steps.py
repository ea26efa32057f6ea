"""One tick of the real-time controller, solved exactly: with floats where modes are shared, else with NumPy."""

import math
from collections.abc import Callable, Sequence
from operator import mul

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.places import Norm, Vector, deviation, moved

Numbers = Sequence[float] | Floats
State = tuple[Vector, Vector]
"""Place and velocity."""
Solved = tuple[Vector, Vector, float]
Solve = Callable[[Vector, Vector, Vector, tuple[Vector, Vector], float, float], Solved]
Scale = float | Vector
"""Scale of the stiffness: that of all, or those of positions and of rotations."""
Advance = Callable[[Vector, Vector, State, float, float], tuple[State, Scale]]

# Of (w h)^2, w the frequency of an axis and h the step: below, two terms of a series in it have all digits.
_CRITICAL = 1e-7
# Of a h, a half the damping: below, five terms have.
_SHORT = 0.01


def advance_plane(row: Vector, push: Vector, state: State, step: float, pull_limit: float) -> tuple[State, float]:
    """Place and velocity after ``step`` s, and the scale of the stiffness: `along_modes` for d = 2, written out."""
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


def along_modes(
    row: Vector, push: Vector, off: Vector, state: tuple[Vector, Vector], step: float, pull_limit: float
) -> Solved:
    """Move and velocity after ``step`` s, and the scale of the stiffness; each mode by itself.

    Modes, the columns of P, are such that P' M P = 1, while P' K P and P' D P are diagonal: with e = P y and f of a
    mode that of P' f, each y follows y'' + 2 a y' + k y = f + 2 a v_d. For a mass m in all directions they are its
    axes, with all per kg. With the responses S and B of `_responses` and q = f + 2 a v_d - k y, y grows by S v + B q
    and v by S q - (2 a S + k B) v: increments, which keep their digits in short ticks.

    A row has the largest stiffness, k and a of each mode, the rows of P' M, which tell y from e, and those of P', which
    are the same for one mass in all directions and are then left out.
    """
    (goal_velocity, velocity), d = state, len(push)
    stiffness, decay = row[1 : d + 1], row[d + 1 : 2 * d + 1]
    maps = [row[start : start + d] for start in range(2 * d + 1, len(row), d)]
    tells, shapes = maps[:d], maps[-d:]
    y = [_dot(tell, off) for tell in tells]
    pull = row[0] * sum([k * part * part for k, part in zip(stiffness, y, strict=True)])
    scale = pull_limit / math.sqrt(pull) if pull > pull_limit * pull_limit else 1.0
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


def coupled(
    row: Vector, push: Vector, off: Vector, state: tuple[Vector, Vector], step: float, pull_limit: float
) -> Solved:
    """As `along_modes` for matrices that share no modes: exp(X) - 1 of the whole system, time in ticks.

    A row has the largest stiffness, K, D, and the inverse of a mass that is not the same in all directions.
    """
    (goal_velocity, velocity), d = state, len(push)
    stiffness, damping, *inverse = np.array(row[1:]).reshape(-1, d, d)
    pull = row[0] * (off @ stiffness @ off)
    scale = pull_limit / math.sqrt(pull) if pull > pull_limit * pull_limit else 1.0
    gains = np.concatenate([-scale * stiffness, -damping, (push + damping @ goal_velocity)[:, None]], axis=1)
    for each in inverse:
        gains = each @ gains
    rate = np.zeros((2 * d + 1, 2 * d + 1))
    rate[:d, d:-1] = np.eye(d)
    rate[d:-1] = gains * np.repeat([step**2, step, step**2], [d, d, 1])
    change = expm1(rate) @ np.concatenate([off, np.multiply(step, velocity), [1.0]])
    return tuple(change[:d].tolist()), tuple(np.add(velocity, change[d:-1] / step).tolist()), scale


def advance_with(solve: Solve, n_place: int, d: int) -> Advance:
    """Function as `advance_plane` for places of ``n_place`` floats and d axes, by one of those above.

    For poses the angular velocity is integrated over the tick as that of a fixed axis would be, and turns the robot in
    world axes: ``R <- Exp(dr) R``. The deviation is then told anew from where both are, so that the transport of it by
    the desired rotation, which turns e by w_d x e, comes out by itself.
    """

    def advance(row: Vector, push: Vector, state: State, step: float, pull_limit: float) -> tuple[State, Scale]:
        place, velocity = state
        motion, off = (row[n_place : n_place + d], velocity), deviation(place, row[:n_place], d)
        move, velocity, scale = solve(row[n_place + d :], push, off, motion, step, pull_limit)
        return (moved(place, move), velocity), scale

    return advance


def advance_apart(solve: Solve, p: int, d: int) -> Advance:
    """As `advance_with` for poses whose positions and rotations have springs apart, each with a limit of its own.

    Each spring has a potential of its own then, and a scale: twisted beyond its torque, a tool keeps its stiffness
    along the way. A row has, before what the function takes, the largest stiffness over squared limit of the two, and
    the two stiffnesses. Where a limit acts, modes are no longer shared, unless both scales are the same.
    """
    start, middle = p + 4 + d, p + 6 + d
    rotation, gains = middle + p * p, middle + p * p + 9

    def advance(row: Vector, push: Vector, state: State, step: float, _: float) -> tuple[State, Scale]:
        place, velocity = state
        motion, off = (row[p + 4 : start], velocity), deviation(place, row[: p + 4], d)
        pull = row[start] * _quadratic(row[middle:rotation], off[:p])
        torque = row[start + 1] * _quadratic(row[rotation:gains], off[p:])
        if pull <= 1.0 >= torque:
            move, velocity, _scale = solve(row[gains:], push, off, motion, step, math.inf)
            return (moved(place, move), velocity), 1.0
        scales = 1.0 / math.sqrt(max(pull, 1.0)), 1.0 / math.sqrt(max(torque, 1.0))
        scaled = _scaled(row[gains:], solve is coupled, np.repeat(scales, [p, 3]))
        move, velocity, _scale = coupled(scaled, push, off, motion, step, math.inf)
        return (moved(place, move), velocity), scales

    return advance


def _scaled(row: Vector, is_coupled: bool, scales: Floats) -> Vector:
    """Row for `coupled` with a stiffness scaled on each axis, from one for that or for `along_modes`."""
    d = len(scales)
    if is_coupled:
        stiffness, *others = np.array(row[1:]).reshape(-1, d, d)
    else:
        values, decays, *maps = np.split(np.array(row[1:]), [d, 2 * d, 2 * d + d * d])
        tells, shapes = (part.reshape(-1, d) for part in maps)
        stiffness, others = tells.T * values @ tells, [tells.T * 2.0 * decays @ tells]
        others += [shapes.T @ shapes] if len(shapes) else []
    return (0.0, *np.concatenate([scales[:, None] * stiffness, *others]).ravel().tolist())


def _quadratic(matrix: Vector, x: Vector) -> float:
    d = len(x)
    return sum([part * _dot(matrix[i * d : (i + 1) * d], x) for i, part in enumerate(x)])


def expm1(matrix: Floats) -> Floats:
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


def braked(state: State, norm: Norm, deceleration: float, step: float) -> State:
    """Place and velocity after braking for ``step`` s, all axes alike, or until standing still."""
    place, velocity = state
    speed = norm(velocity)
    braking = min(step, speed / deceleration)
    left = 1.0 - deceleration * step / speed if braking == step else 0.0
    slower = tuple([left * component for component in velocity])
    return moved(place, mean_move(velocity, slower, braking)), slower


def mean_move(before: Vector, after: Vector, time: float) -> Vector:
    """Move in a time in which the velocity changes evenly."""
    return tuple([0.5 * time * (v + w) for v, w in zip(before, after, strict=True)])


def _dot(left: Vector, right: Vector) -> float:
    return sum(map(mul, left, right))
