"""Rows derived from a schedule's: interpolated, damped for an inertia, in another frame, with diagonal gains."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_memory

# Share of a tick that counts as rounding: 10 s at 1 kHz are 10001 rows, however 10 * 1000 is rounded, and time stamps
# resolve a duration to a thousandth of their spacing, so that a shorter last interval counts as none.
_ROUNDING = 1e-3
# Share of a mass that counts as equal: functions of time are not linear between rows, and damping ratios vary by half.
_SAME_MASS = 1e-3
UNEVEN = 1e-6
"""Share of a tick that counts as rounding of its length: times of an hour at 1 kHz err by 5e-10 of one in float64."""
_NOT_SI = ("km", "dm", "cm", "mm", "um", "deg")  # lengths and angles that are known, and neither m nor rad


def count_rows(duration: float, rate: float) -> int:
    """Number of rows every ``1 / rate`` within a duration and one at its end; 1 if it is shorter than a tick."""
    ticks = duration * rate
    return math.ceil(ticks - _ROUNDING) + 1 if ticks + _ROUNDING >= 1.0 else 1


def row_times(duration: float, rate: float) -> Floats:
    """Times (n,), n >= 2, of rows every ``1 / rate`` and at the end; the last interval may be shorter."""
    return np.append(np.arange(max(count_rows(duration, rate) - 1, 1)) / rate, duration)


def tick_times(duration: float, rate: float, d: int, *, settle: float = 0.0) -> Floats:
    """Times (n,), n >= 2, of the rows of a schedule of d axes at a rate in Hz, checked to fit in memory.

    The rate, and ``settle``, the time in s after the duration, are checked.
    """
    rate = checks.number(rate, "rate", above=0.0, unit="Hz")
    duration += checks.number(settle, "settle", least=0.0, unit="s")
    counted = duration * rate + 1.0
    require_memory(  # its arrays, and twice as much while they are made
        3 * 8 * counted * (2 + 2 * d + 3 * d * d),
        what=f"a schedule of {counted:.7g} ticks of {d} axes",
        remedy="Lower rate, and let the robot interpolate between its rows.",
    )
    if count_rows(duration, rate) < 2:
        raise checks.refusal(rate, "rate", f"at least {1 / duration:g} Hz, for two rows", unit="Hz")
    return row_times(duration, rate)


def even_step(time: Floats) -> float:
    """Time between the rows of a schedule, of which the last alone may come sooner."""
    steps = np.diff(time)
    if np.ptp(steps[:-1]) > UNEVEN * steps[0] or steps[-1] > (1.0 + UNEVEN) * steps[0]:
        raise InvalidParameterError(
            f"schedule has steps from {steps.min():g} to {steps.max():g} s, must be evenly spaced: take "
            "schedule.resample(rate)."
        )
    return float(steps[0])


class Between:
    """Interpolation at times (m,) between the rows of a schedule at ``knots`` (n,), n >= 2."""

    def __init__(self, knots: Floats, times: Floats) -> None:
        self._row = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
        self._step = knots[self._row + 1] - knots[self._row]
        self._share = (times - knots[self._row]) / self._step

    def linear(self, values: Floats) -> Floats:
        """Linear interpolation (m, ...) of values (n, ...)."""
        return _blend(values[self._row], values[self._row + 1], self._share)

    def motion(self, schedule: Any) -> tuple[Floats, Floats, Floats | None]:
        """Position (m, p), velocity (m, d) and orientation (m, 4) or None, of the schedule with these rows."""
        p, row = schedule.position.shape[1], self._row
        first, second = (schedule.velocity[rows] for rows in (row, row + 1))
        places = schedule.position[row], schedule.position[row + 1]
        position, velocity = self._cubic(*places, first[:, :p], second[:, :p])
        if schedule.orientation is None:
            return position, velocity, None
        # The cubic of each interval is that of the rotation vector y from its first row, R = R_row Exp(y).
        start = schedule.orientation[row]
        turn = rotations.log(rotations.multiply(rotations.conjugate(start), schedule.orientation[row + 1]))
        to_body = rotations.matrix(start).swapaxes(1, 2)
        begins, ends = ((to_body @ twist[:, p:, np.newaxis])[..., 0] for twist in (first, second))
        ends = np.linalg.solve(rotations.left_jacobian(turn), ends[..., np.newaxis])[..., 0]
        vector, rate = self._cubic(np.zeros_like(turn), turn, begins, ends)
        turning = to_body.swapaxes(1, 2) @ rotations.left_jacobian(vector) @ rate[..., np.newaxis]
        orientation = rotations.multiply(start, rotations.exp(vector))
        return position, np.concatenate([velocity, turning[..., 0]], axis=1), orientation

    def _cubic(self, first: Floats, last: Floats, start: Floats, end: Floats) -> tuple[Floats, Floats]:
        """Cubic from the first to the last values (m, d) with the rates at start and end, and its derivative."""
        s, h = self._share[:, np.newaxis], self._step[:, np.newaxis]
        cubic = _blend(first, last, self._share**2 * (3.0 - 2.0 * self._share))
        bend = h * s * (1.0 - s) * ((1.0 - s) * start - s * end)
        slope = _blend(start, end, self._share) + 3.0 * s * (1.0 - s) * (2.0 * (last - first) / h - start - end)
        return cubic + bend, slope


def _blend(start: Floats, end: Floats, share: Floats) -> Floats:
    """Straight line from start to end, exact at both and where they are equal, unlike (1 - s) a + s b."""
    share = share.reshape(-1, *[1] * (start.ndim - 1))
    return np.where(share < 0.5, start + share * (end - start), end - (1.0 - share) * (end - start))


def damped_rows(schedule: Any, damping_ratio: float, law: Any) -> dict[str, Any]:
    """Damping, and with a law also stiffness, for the mass of a schedule; see :meth:`Schedule.with_inertia`.

    The damping is ``2 zeta L (L^-1 K L^-T)^1/2 L'`` with M = L L'. For every factor L it is twice zeta times the
    geometric mean of M and K, as in :func:`~torch_pbd.control.damping_from_stiffness`, which takes the root of M.
    """
    ratio = checks.number(damping_ratio, "damping_ratio", least=0.0, most=1e6, remedy="1 is critical")
    rows = {"stiffness": schedule.stiffness}
    mass = schedule.mass * np.eye(schedule.n_outputs) if isinstance(schedule.mass, float) else schedule.mass
    if law is not None:
        if not hasattr(law, "limits"):  # to name its class would need torch
            raise checks.refusal(law, "law", "a StiffnessLaw or None")
        rows["stiffness_limits"] = law.limits(schedule.n_outputs)
        rows["stiffness"] = np.asarray(law(schedule.covariance, mass, type1=schedule.type1))
    factor = np.broadcast_to(np.linalg.cholesky(mass), schedule.stiffness.shape)
    half = np.linalg.solve(factor, rows["stiffness"])
    squared, axes = np.linalg.eigh(np.linalg.solve(factor, half.swapaxes(1, 2)))
    modes = factor @ axes * squared.clip(0.0)[:, np.newaxis] ** 0.25
    return rows | {"damping": 2.0 * ratio * modes @ modes.swapaxes(1, 2)}


def refuse_other_units(schedule: Any) -> None:
    """Refuse a schedule whose gains, in N/m or Nm/rad, are not those of its positions: forces would move it too little.

    Units that nobody knows pass: gains may be in them too.
    """
    if schedule.units in _NOT_SI:
        must, remedy = "'m' or 'rad', as of N/m and Nm/rad", "convert position, velocity, acceleration and covariance"
        raise checks.refusal(schedule.units, "units of schedule", must, remedy)


def warn_of_another_mass(schedule: Any, mass: Floats, who: str) -> None:
    """Warn if a mass, (), (d, d) or (n, d, d), is not that which the damping of a schedule was computed for."""
    if schedule.mass is None:
        return
    identity = np.eye(schedule.n_outputs)
    own, used = (each if np.ndim(each) else each * identity for each in (schedule.mass, mass))
    # Entries are compared in units of their axes.
    root = np.sqrt(np.diagonal(own, axis1=-2, axis2=-1))
    off = float(np.max(np.abs(used - own) / (root[..., np.newaxis] * root[..., np.newaxis, :])))
    if off > _SAME_MASS:
        met = f"mass={schedule.mass:g} kg" if isinstance(schedule.mass, float) else "the inertia of the schedule"
        checks.warn(
            f"{who}, but damping_ratio was met for {met}, off by up to {off:.0%}: give both the same, or mass=None, "
            "which is the schedule's."
        )


def turned_rows(schedule: Any, rotation: ArrayLike, translation: ArrayLike | None) -> dict[str, Any]:
    """Arrays of a schedule after a rotation and a translation; see :meth:`Schedule.transform`."""
    p = schedule.position.shape[1]
    if schedule.units in ("rad", "deg"):
        raise InvalidParameterError(
            f"the positions are in {schedule.units}, must be coordinates of a point: joint angles have no frame."
        )
    turn = checks.real_floats(rotation, "rotation")
    if turn.shape == (4,) and p == 3:
        turn = rotations.matrix(turn / np.linalg.norm(turn))
    turn = checks.array(turn, "rotation", (p, p))
    if not np.allclose(turn @ turn.T, np.eye(p), atol=1e-6) or np.linalg.det(turn) < 0.0:
        raise checks.refusal(turn.tolist(), "rotation", "a rotation matrix, of which R R' = I and det R = 1")
    for limit in schedule.stiffness_limits or ():
        if np.ndim(limit) and any(np.ptp(np.asarray(limit)[block]) > 0.0 for block in schedule.blocks):
            must = "the same for all axes that turn into each other"
            remedy = "give schedules limits for each block, or none"
            raise checks.refusal(schedule.stiffness_limits, "stiffness_limits", must, remedy)
    whole = np.kron(np.eye(len(schedule.blocks)), turn)
    moved = 0.0 if translation is None else checks.array(translation, "translation", (p,))
    rows = {"position": schedule.position @ turn.T + moved, "velocity": schedule.velocity @ whole.T}
    if schedule.acceleration is not None:
        rows["acceleration"] = schedule.acceleration @ whole.T
    if schedule.orientation is not None:
        rows["orientation"] = rotations.multiply(rotations.from_matrix(turn), schedule.orientation)
    matrices = {name: getattr(schedule, name) for name in ("stiffness", "damping", "covariance", "mass")}
    return rows | {name: whole @ array @ whole.T for name, array in matrices.items() if isinstance(array, np.ndarray)}


@final
@dataclass(frozen=True)
class DiagonalLoss:
    """Error of a controller that uses only the diagonals of stiffness and damping; 0 if these are diagonal.

    Attributes
    ----------
    displacement : float
        Largest ||x - x_diagonal|| / ||x|| over all times and all forces or torques, which displace the robot by x under
        the full stiffness. At 1 the error is as large as the displacement.
    velocity : float
        Largest relative error of the velocity under a force where damping alone acts.
    time : float
        Time of the largest error of the displacement, in s.
    """

    displacement: float
    velocity: float
    time: float

    def __str__(self) -> str:
        return (
            "diagonal gains lose what couples axes: displacements under a force or a torque are off by up to "
            f"{self.displacement:.1%}, at {self.time:.6g} s, velocities where damping alone acts by {self.velocity:.1%}"
        )


def diagonal_gains(schedule: Any) -> tuple[Floats, Floats, DiagonalLoss]:
    """Diagonal stiffness and damping (n, d, d) of a schedule, and the error they cause."""
    # The nearest diagonal matrix, in the Frobenius norm, is the diagonal itself. It lies between the least and the
    # largest eigenvalue, so within the limits too; rounding may leave it below zero.
    gains = schedule.stiffness, schedule.damping
    stiffness, damping = (np.eye(schedule.n_outputs) * np.maximum(gain, 0.0) for gain in gains)
    displacement, velocity = (_diagonal_error(gain, schedule.blocks) for gain in gains)
    worst = int(displacement.argmax())
    loss = DiagonalLoss(float(displacement[worst]), float(velocity.max()), float(schedule.time[worst]))
    return stiffness, damping, loss


def _diagonal_error(gain: Floats, blocks: Sequence[slice]) -> Floats:
    """Largest relative error (n,) of the response to a force or torque if gains (n, d, d) are reduced to diagonals D.

    x = K^-1 f and D^-1 f differ by (I - D^-1 K) x: by its spectral norm, for the worst x.
    """
    along = np.maximum(np.diagonal(gain, axis1=1, axis2=2), 0.0)[..., np.newaxis]
    coupling = (along * np.eye(gain.shape[1]) - gain) / np.where(along > 0.0, along, 1.0)
    return np.max([np.linalg.norm(coupling[:, b, b], ord=2, axis=(1, 2)) for b in blocks], axis=0)
