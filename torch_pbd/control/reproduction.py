"""The mean movement of demonstrations as a movement primitive drives it."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor

from torch_pbd.control.dmp import DMP
from torch_pbd.control.forcing import ForcingProcess
from torch_pbd.control.smoothing import Movements, check_range

Floats = NDArray[np.float64]

_TICKS = 4000  # within the duration
_FAR = 0.01  # of the extent of a movement
_SETTLE = 20.0  # time constants after the end at which the movement is at rest


@dataclass(frozen=True)
class Reproduction:
    """A movement primitive with its forcing, and the motion that follows from them.

    Parameters
    ----------
    dmp : DMP
        With the duration of the movement.
    phase : Phase
        What the forcing was learned over.
    own_goals : bool
        Whether eq. (18) takes the end of each movement for its goal, or the common goal.
    start, velocity, goal : ndarray of shape (d,)
        Where the movement starts, how fast, and where it ends.
    time : ndarray of shape (m,)
        Of the duration.
    forcing : ndarray of shape (m, d)
        Linear between these times; after the last it is held, under the gate.
    """

    dmp: DMP
    phase: "Phase"
    own_goals: bool
    start: Floats
    velocity: Floats
    goal: Floats
    time: Floats
    forcing: Floats

    @classmethod
    def learn(cls, dmp: DMP, movements: Movements, phase_input: str, *, own_goals: bool) -> "Reproduction":
        """Fit the forcing of the mean movement, and tabulate it over the duration."""
        phase, position = Phase(dmp, phase_input), movements.position
        start, velocity = position[:, 0].mean(axis=0), movements.velocity[:, 0].mean(axis=0)
        goal = position[:, -1].mean(axis=0)
        time = np.linspace(0.0, movements.time[-1], _TICKS + 1)
        known = cls(dmp, phase, own_goals, start, velocity, goal, time, np.zeros((len(time), len(goal))))
        process = ForcingProcess(phase(movements.time), known.forcing_of(movements).mean(axis=0), n_demos=len(position))
        return replace(known, forcing=process.predict(phase(time)))

    def forcing_of(self, movements: Movements) -> Floats:
        """Forcing (K, n, d) that would reproduce each movement: eq. (18)."""
        goal = movements.position[:, -1:] if self.own_goals else self.goal
        goals = np.broadcast_to(goal, movements.position.shape)
        parts = (movements.position, movements.velocity, movements.acceleration, goals)
        forcing: Floats = self.dmp.forcing(*map(_tensor, parts)).numpy()
        return forcing

    def check_against(self, movements: Movements) -> float:
        """Root mean square distance of the motion from the mean of the movements as they were recorded.

        Raises
        ------
        ValueError
            If it leaves the recorded range of an output by more than a tenth of it.

        Warns
        -----
        UserWarning
            If it is more than 1 % of the extent of all movements.
        """
        mean, path = movements.recorded_mean, self.motion(movements.time)[0]
        check_range(path, movements.bounds, "The reproduced movement")
        distance = np.linalg.norm(path - mean, axis=1)
        error = float(np.sqrt(np.mean(distance**2)))
        extent = float(np.linalg.norm(np.ptp(movements.bounds, axis=0)))
        rounding = 1e-9 * float(np.abs(mean).max())
        if error > _FAR * extent + rounding:
            remedy = "phase_input='time'" if self.phase.kind == "s" else "a higher cutoff, or more n_steps"
            warnings.warn(
                f"The reproduced movement is {error:.3g} off the mean of the demonstrations, {error / extent:.1%} of "
                f"its extent: try {remedy}.",
                stacklevel=3,
            )
        return error

    def forcing_at(self, time: Tensor) -> Tensor:
        """Forcing (m, d), before the gate, at times (m,)."""
        columns = [np.interp(time.numpy(), self.time, column) for column in self.forcing.T]
        return torch.tensor(np.stack(columns, axis=1))

    def motion(self, time: Floats) -> tuple[Floats, Floats]:
        """Position and velocity (n, d) at any times (n,): at rest at the start before 0, and long after the end.

        The primitive is solved exactly at 4000 ticks in the duration, and interpolated by cubics between.
        """
        curve, end = self._settled_motion, self._settled_motion.x[-1]
        within = np.clip(time, 0.0, end)
        moving = ((time >= 0.0) & (time <= end))[:, np.newaxis]
        return curve(within), np.where(moving, curve(within, 1), 0.0)

    @cached_property
    def _settled_motion(self) -> CubicHermiteSpline:
        step, dmp = float(self.time[1]), self.dmp
        slowest = max(2.0 * dmp.tau / dmp.alpha, dmp.tau / dmp.gamma if dmp.gate == "phase" else 0.0)
        n_ticks = len(self.time) + int((_SETTLE * slowest + 0.1 * self.time[-1]) / step)
        return CubicHermiteSpline(*self.roll_out(n_ticks, step), axis=0)

    def roll_out(
        self,
        n_ticks: int,
        dt: float,
        *,
        goal: ArrayLike | None = None,
        start: ArrayLike | None = None,
        speed: ArrayLike | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """Time (n,), position and velocity (n, d); see :meth:`DMPController.reproduce`."""
        pace = None if speed is None else np.asarray(speed, dtype=np.float64)
        for name, value in (("goal", goal), ("start", start), ("speed", speed)):
            if value is not None and not np.isfinite(np.asarray(value, dtype=np.float64)).all():
                raise ValueError(f"{name} has a value that is not finite: {value!r}.")
        position, velocity = self.dmp.rollout(
            self.forcing_at,
            dt,
            goal=_tensor(self.goal if goal is None else goal),
            position0=_tensor(self.start if start is None else start),
            velocity0=_tensor(self.velocity * (1.0 if pace is None else pace[0])),
            speed=None if pace is None else _tensor(pace),
            n_steps=n_ticks,
        )
        ticks: Floats = np.arange(n_ticks, dtype=np.float64) * dt
        return ticks, position.numpy(), velocity.numpy()


@dataclass(frozen=True)
class Phase:
    """Movement time as the regressors see it: a column of the phase, its logarithm, or the time itself."""

    dmp: DMP
    kind: str

    def __call__(self, time: Floats) -> Floats:
        """Inputs (n, 1) at times (n,)."""
        if self.kind == "time":
            return time[:, np.newaxis]
        if self.kind == "log_s":
            return (-self.dmp.gamma * time / self.dmp.tau)[:, np.newaxis]
        return self.dmp.phase(_tensor(time)).numpy()[:, np.newaxis]


def _tensor(values: ArrayLike) -> Tensor:
    return torch.tensor(np.asarray(values, dtype=np.float64, order="C"))
