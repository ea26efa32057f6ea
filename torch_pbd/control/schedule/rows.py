"""Rows of a schedule between its own: how many at a rate, and what motion and gains are there."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.files.memory import require_memory

# Of a tick: 10 s at 1 kHz are 10001 rows, however 10 * 1000 is rounded; and stamps tell a duration to the thousandth of
# their spacing, beyond which they count as one, so that a last interval shorter than that is none.
_ROUNDING = 1e-3


def count_rows(duration: float, rate: float) -> int:
    """Rows every ``1 / rate`` within a duration, and one at its end; 1 if it is shorter than a tick."""
    ticks = duration * rate
    return math.ceil(ticks - _ROUNDING) + 1 if ticks + _ROUNDING >= 1.0 else 1


def row_times(duration: float, rate: float) -> Floats:
    """Times (n,) of these rows: the last interval may be shorter."""
    return np.append(np.arange(count_rows(duration, rate) - 1) / rate, duration)


def tick_times(duration: float, rate: float, d: int, *, settle: float = 0.0) -> Floats:
    """Times (n,), n >= 2, of the rows of a schedule of d axes at a rate in Hz, if they fit in memory.

    Rate, and the time in s by which the schedule ends after the duration, are checked.
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


def blend(start: Floats, end: Floats, share: Floats) -> Floats:
    """Straight line from start to end, exact at both and where they agree, which (1 - s) a + s b is not."""
    share = share.reshape(-1, *[1] * (start.ndim - 1))
    return np.where(share < 0.5, start + share * (end - start), end - (1.0 - share) * (end - start))


class Between:
    """Places of times (m,) between the rows of a schedule at ``knots`` (n,), n >= 2."""

    def __init__(self, knots: Floats, times: Floats) -> None:
        self._row = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
        self._step = knots[self._row + 1] - knots[self._row]
        self._share = (times - knots[self._row]) / self._step

    def linear(self, values: Floats) -> Floats:
        """Values (n, ...) on straight lines, (m, ...)."""
        return blend(values[self._row], values[self._row + 1], self._share)

    def motion(self, schedule: Any) -> tuple[Floats, Floats, Floats | None]:
        """Position (m, p), velocity (m, d) and orientation (m, 4), or None, of a schedule whose rows these are."""
        p = schedule.position.shape[1]
        position, velocity = self.hermite(schedule.position, schedule.velocity[:, :p])
        if schedule.orientation is None:
            return position, velocity, None
        orientation, turning = self.hermite_rotation(schedule.orientation, schedule.velocity[:, p:])
        return position, np.concatenate([velocity, turning], axis=1), orientation

    def hermite(self, position: Floats, velocity: Floats) -> tuple[Floats, Floats]:
        """Cubic through positions (n, d) with these velocities (n, d), and its derivative."""
        row = self._row
        return self._cubic(position[row], position[row + 1], velocity[row], velocity[row + 1])

    def hermite_rotation(self, orientation: Floats, velocity: Floats) -> tuple[Floats, Floats]:
        """Quaternions (m, 4) between those of the rows (n, 4), and angular velocities, in world axes (n, 3) as given.

        The cubic of each interval is that of the rotation vector y from its first row, ``R = R_row Exp(y)``.
        """
        row = self._row
        start = orientation[row]
        turn = rotations.log(rotations.multiply(rotations.conjugate(start), orientation[row + 1]))
        to_body = rotations.matrix(start).swapaxes(1, 2)
        begins = (to_body @ velocity[row, :, np.newaxis])[..., 0]
        ends = np.linalg.solve(rotations.left_jacobian(turn), to_body @ velocity[row + 1, :, np.newaxis])[..., 0]
        vector, rate = self._cubic(np.zeros_like(turn), turn, begins, ends.astype(float))
        turning = to_body.swapaxes(1, 2) @ rotations.left_jacobian(vector) @ rate[..., np.newaxis]
        return rotations.multiply(start, rotations.exp(vector)), turning[..., 0]

    def _cubic(self, first: Floats, last: Floats, start: Floats, end: Floats) -> tuple[Floats, Floats]:
        """Cubic from the first to the last values (m, d) with the rates at start and end, and its derivative."""
        s, h = self._share[:, np.newaxis], self._step[:, np.newaxis]
        cubic = blend(first, last, self._share**2 * (3.0 - 2.0 * self._share))
        bend = h * s * (1.0 - s) * ((1.0 - s) * start - s * end)
        slope = blend(start, end, self._share) + 3.0 * s * (1.0 - s) * (2.0 * (last - first) / h - start - end)
        return cubic + bend, slope


def ranges_of(matrices: Floats, blocks: Sequence[slice], units: Sequence[str]) -> str:
    """Least and largest eigenvalue of each block of matrices (..., d, d), in words."""
    ranges = []
    for block, unit in zip(blocks, units, strict=False):
        eigenvalues = np.linalg.eigvalsh(matrices[..., block, block])
        low, high = (f"{value:.4g}" for value in (eigenvalues.min(), eigenvalues.max()))
        ranges.append(f"{low} {unit}" if low == high else f"{low}..{high} {unit}")
    return " and ".join(ranges)
