"""The mean movement of demonstrations as a movement primitive drives it."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor

from torch_pbd.control.primitive.adaptation import adapt
from torch_pbd.control.primitive.dmp import DMP
from torch_pbd.control.primitive.forcing import ForcingProcess
from torch_pbd.control.primitive.smoothing import Movements, check_range

Floats = NDArray[np.float64]

_TICKS = 4000  # within the duration
_FAR = 0.01  # of the extent of a movement
_SETTLE = 20.0  # time constants after the end at which the movement is at rest
_BRAKE = 0.2  # of the duration: the most that the stop of a movement that was cut may take
_CUT, _STEADY, _STOPPED = 0.1, 0.5, 0.1  # of the largest speed, the last in m/s; see check_ends
_ROUNDING = 1e-9  # of the duration


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

    def check_ends(self, metres: float) -> None:
        """Warn of a movement that was cut while moving, which a robot at rest cannot follow at once.

        Told is who cuts more than 6 % of a minimum jerk, which has a tenth of its largest speed there. Not told are
        movements that keep above half of their largest speed, which are meant to pass, and what a robot stops within
        1 mm at 5 m/s^2: 0.1 m/s. A unit of position is so many ``metres``.
        """
        speed = metres * np.linalg.norm(self._curve(self.time, 1), axis=1)
        ends, largest = max(float(speed[0]), float(speed[-1])), float(speed.max())
        if ends > max(_CUT * largest, _STOPPED) and speed.min() < _STEADY * largest:
            warnings.warn(
                f"The movement starts at {speed[0]:.3g} m/s and ends at {speed[-1]:.3g} m/s, where its largest is "
                f"{largest:.3g}: the recordings were cut while moving. Record from rest to rest; else a robot at rest "
                "needs a ramp at the start, and settle > 0 at the end.",
                stacklevel=3,
            )

    def forcing_at(self, time: Tensor) -> Tensor:
        """Forcing (m, d), before the gate, at times (m,)."""
        columns = [np.interp(time.numpy(), self.time, column) for column in self.forcing.T]
        return torch.tensor(np.stack(columns, axis=1))

    def motion(self, time: Floats) -> tuple[Floats, Floats]:
        """Position and velocity (n, d) at any times (n,): at rest at the start before 0, and long after the end.

        The primitive is solved exactly at 4000 ticks in the duration, and interpolated by cubics between. With
        adaptation="safe" it is over with the duration.
        """
        curve, end = self._curve, self._curve.x[-1]
        within = np.clip(time, 0.0, end)
        moving = ((time >= 0.0) & (time <= end))[:, np.newaxis]
        return curve(within), np.where(moving, curve(within, 1), 0.0)

    @cached_property
    def _curve(self) -> CubicHermiteSpline:
        step, dmp, time = float(self.time[1]), self.dmp, self.time
        if dmp.adaptation != "safe":
            slowest = max(2.0 * dmp.tau / dmp.alpha, dmp.tau / dmp.gamma if dmp.gate == "phase" else 0.0)
            n_ticks = len(time) + int((_SETTLE * slowest + 0.1 * time[-1]) / step)
            time = np.array(step * np.arange(n_ticks), dtype=np.float64)
        goal, start, velocity = map(_tensor, (self.goal, self.start, self.velocity))
        run = dmp.rollout(self.forcing_at, step, goal=goal, position0=start, velocity0=velocity, n_steps=len(time))
        positions, velocities = (part.numpy() for part in run)
        if dmp.adaptation == "safe":  # what is left at the end is taken out as a change of the goal is
            left, share = positions[-1] - self.goal, time[:, np.newaxis] / time[-1]
            positions -= left * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            velocities -= left * 30.0 * (share * (1.0 - share)) ** 2 / time[-1]
        return CubicHermiteSpline(time, positions, velocities, axis=0)

    def plan(
        self, time: Floats, *, goal: Floats | None = None, start: Floats | None = None, speed: float | Floats = 1.0
    ) -> tuple[Floats, Floats, Floats]:
        """Position and velocity (n, d) at times (n,) from 0, and movement time (n,) of the gains there.

        To goals (d,) or (n, d), from a start (d,), at one speed or those of all times. With adaptation="safe" it brakes
        to rest at the end of the movement, if the times go on after it.
        """
        pace = np.broadcast_to(np.asarray(speed, dtype=np.float64), time.shape)
        steps = 0.5 * (pace[1:] + pace[:-1]) * np.diff(time)
        passed = time * speed if np.ndim(speed) == 0 else np.append(0.0, np.cumsum(steps))
        goals = np.broadcast_to(self.goal if goal is None else goal, (len(time), len(self.goal)))
        known, (position, velocity) = passed, self.motion(passed)
        if self.dmp.adaptation == "safe":
            moved, rate, known = self._braked(passed)
            path = [self._curve(moved, order) * rate[:, np.newaxis] ** order for order in range(3)]
            if goal is not None or start is not None:
                whole = _tensor(self._curve(self.time)), _tensor(self.time)
                ends = {"own_goal": self.goal, "goals": goals, "start": self.start if start is None else start}
                places = {name: _tensor(place) for name, place in ends.items()}
                run = adapt(tuple(map(_tensor, path)), _tensor(passed), whole, **places, duration=float(self.time[-1]))
                path = [part.numpy() for part in run]
            position, velocity = path[:2]
        elif goal is not None or start is not None:
            # The primitive is linear: another start and goal add its answer to their change alone.
            still, offset = torch.zeros(goals.shape, dtype=torch.float64), np.zeros(len(self.goal))
            change = {"goal": goals - self.goal, "position0": offset if start is None else start - self.start}
            run = self.dmp.rollout(
                still, float(time[1]), **{n: _tensor(x) for n, x in change.items()}, speed=_tensor(pace)
            )
            answer = CubicHermiteSpline(time[1] * np.arange(len(time)), *(part.numpy() for part in run), axis=0)
            return position + answer(time), velocity * pace[:, np.newaxis] + answer(time, 1), known
        return position, velocity * pace[:, np.newaxis], known

    def _braked(self, passed: Floats) -> tuple[Floats, Floats, Floats]:
        """Movement time (n,) that comes to rest at the end of the movement, its rate, and the time of the gains (n,).

        What was cut at a speed v stops on its own path, half before the end and half after it, in 1.5 v / a, which
        takes its own largest acceleration a; or in a fifth of the duration, or in what time there is, if that is less.
        """
        end, curve = float(self.time[-1]), self._curve
        largest = max(float(np.linalg.norm(curve(self.time, 2), axis=1).max()), np.finfo(float).tiny)
        needed = 1.5 * float(np.linalg.norm(curve(end, 1))) / largest
        brake = max(0.0, min(needed, _BRAKE * end, 2.0 * (float(passed[-1]) - end)))
        late = (passed - end) / end
        share = np.clip(late * end / brake + 0.5, 0.0, 1.0) if brake > _ROUNDING * end else 1.0 * (late > _ROUNDING)
        moved = np.minimum(passed, end - 0.5 * brake) + brake * (share - share**3 + 0.5 * share**4)
        rate = 1.0 - share**2 * (3.0 - 2.0 * share)
        return np.minimum(moved, end), rate, np.maximum(moved, passed - 0.5 * brake)


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


def primitive(controller: Any) -> DMP:
    """The primitive of a controller that knows its duration; with adaptation="safe" its tau is that of 10 s."""
    beta = None if controller.beta is None else float(controller.beta)
    tau = float(controller.tau) * (controller.duration_ / 10.0 if controller.adaptation == "safe" else 1.0)
    options = {"duration": controller.duration_, "gate": controller.gate, "adaptation": controller.adaptation}
    return DMP(float(controller.alpha), beta, float(controller.gamma), tau, **options)


def _tensor(values: ArrayLike) -> Tensor:
    return torch.tensor(np.asarray(values, dtype=np.float64, order="C"))
