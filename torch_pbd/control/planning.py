"""Methods of a fitted controller: prediction, conditioning, schedules and simulation."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any, Self, final

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_array, check_is_fitted

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.learning import Gains, gains_at
from torch_pbd.control.primitive.outputs import Outputs
from torch_pbd.control.primitive.reproduction import Reproduction
from torch_pbd.control.schedule.rows import tick_times
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.run import simulate
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.control.via import conditioned, planned
from torch_pbd.data.units import ANGLES, LENGTHS
from torch_pbd.estimators.validation import checked_values

_UNITS = {"duration": "s", "distance": "m", "speed": "m/s"}


@final
@dataclass(frozen=True)
class MotionLimits:
    """Limits that no robot motion exceeds, so that a schedule beyond them must have wrong units.

    Parameters
    ----------
    duration : float, default=600.0
        Largest duration of a movement in s.
    distance : float, default=10.0
        Largest diagonal of the path's bounding box in m.
    speed : float, default=10.0
        Largest speed in m/s.
    """

    duration: float = 600.0
    distance: float = 10.0
    speed: float = 10.0

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            checks.number(getattr(self, name), name, above=0.0, unit=unit)


_LIMITS = MotionLimits()
# Radius of gyration of a virtual mass, m. The inertia felt at the tool of a Panda along the made pose task is 5.01 to
# 16.1 kg and 0.0761 to 0.774 kg m^2 (docs/poses.md): the roots of the ratio are 0.12 and 0.22 m, this their mean.
_LEVER = 0.17
# Share of the duration, before and after the movement, in which observations move it: longer recordings end there.
_BEYOND = 0.2


class Planning(BaseEstimator):
    """Methods of a fitted `torch_pbd.control.DMPController`; abstract."""

    covariance_: Any
    reproduction_: Reproduction
    outputs_: Outputs
    n_outputs_: int
    time_unit_: str
    duration_: float
    start_time_: float
    time_scale_: float
    mass: Any

    @property
    def mass_(self) -> float | Floats:
        """Virtual mass that the gains assume, in kg or for angles kg m^2: a number or a matrix (d, d)."""
        if self.mass is None and self.outputs_.reference is not None:
            return np.diag([1.0] * self.outputs_.n_positions + [_LEVER**2] * 3)
        return 1.0 if self.mass is None else self.mass

    def predict(self, X: ArrayLike) -> Floats:
        """Reproduced outputs (n, d) at times X (n, 1), in the time units and origin of the demonstrations.

        Outputs are positions, and for poses also three coordinates of the rotation, see :meth:`predict_pose`. The
        movement starts at ``start_time_``, ends ``duration_`` later, and then stays at the goal.
        """
        time = self._movement_time(X)
        return self.reproduction_.motion(time)[0]

    def predict_pose(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Reproduced positions (n, p) and orientations (n, 4), unit quaternions w x y z, at times X (n, 1)."""
        path = self.predict(X)
        if self.outputs_.reference is None:
            raise ValueError("The demonstrations have no rotation: predict(X) is all of the movement.")
        return self.outputs_.poses(path)

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariance (n, d, d) of the outputs at times X (n, 1), in squared units; poses are in their chart."""
        time = self._movement_time(X)
        return self.outputs_.covariance(self.covariance_.predict_cov(self.reproduction_.phase(time)))

    def condition(self, times: ArrayLike, positions: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy, conditioned on passing positions: a via point, the part observed so far, or a push.

        All of the movement and its gains follow by the demonstrations' correlation, what lies before too, smoothly:
        positions with noise are passed as near as its smooth part is likely to, at a start that all demonstrations
        share not near; with 0 they are passed exactly. ``covariance`` must be a model of whole movements, with
        variability="position". A copy can be conditioned again.

        Parameters
        ----------
        times : array-like of shape (m,)
            Times of the demonstrations, in their units and origin: from ``start_time_`` to ``duration_`` after it, or
            up to a fifth of that beyond, as in recordings longer than the median.
        positions : array-like of shape (m, d), or (m, p + 4) for poses
            Positions in the units of the recordings, NaN where an output is not given. Poses are p positions and a
            quaternion w x y z, or outputs; a rotation is given as a whole or not at all.
        noise_scale : float or array-like of shape (d,), default=0.0
            Standard deviation of the error of positions, for poses p numbers in their units and three in rad. Positions
            that a robot measured have one, such as 1 mm. Taken as exact where demonstrations agree to much less, they
            are a large deviation, with which other outputs may move far; this warns.
        """
        times = checks.array(times, "times", ("m",))
        time = self._movement_time(times[:, np.newaxis])
        inside = np.abs(time - 0.5 * self.duration_) <= (0.5 + _BEYOND + checks.ROUNDING) * self.duration_
        first, last = (
            self.start_time_ + share * self.duration_ / self.time_scale_ for share in (-_BEYOND, 1 + _BEYOND)
        )
        must, remedy = f"near the movement, {first:.10g} to {last:.10g}", "times are those of the demonstrations"
        checks.require(inside, times, "times", must, remedy, "" if self.time_unit_ == "1" else self.time_unit_)
        position = self.outputs_.rows(positions, "positions")
        if position.shape != (len(time), self.n_outputs_):
            raise ValueError(f"positions has shape {position.shape}, must have shape ({len(time)}, {self.n_outputs_}).")
        if self.outputs_.reference is not None and np.ndim(noise_scale) == 0 and noise_scale != 0.0:
            must = f"0, or {self.n_outputs_} numbers, the last three in rad"
            raise checks.refusal(noise_scale, "noise_scale", must, "m and rad have no scale in common")
        return conditioned(self, time, position - self.reproduction_.motion(time)[0], noise_scale)

    def predict_stiffness(self, X: ArrayLike) -> Floats:
        """Stiffness (n, d, d) at times X (n, 1), in N/m, Nm/rad for angles, and both in world axes for poses."""
        return self._gains(X).stiffness

    def predict_damping(self, X: ArrayLike) -> Floats:
        """Damping (n, d, d) at times X (n, 1), in N s/m or Nm s/rad."""
        return self._gains(X).damping

    def schedule(
        self,
        rate: float = 1000.0,
        *,
        settle: float = 0.0,
        goal: ArrayLike | None = None,
        start: ArrayLike | None = None,
        via: Sequence[tuple[float, ArrayLike]] | None = None,
        speed: float = 1.0,
        limits: MotionLimits | None = _LIMITS,
    ) -> Schedule:
        """Motion and gains at ``rate`` for a robot, in s, m and rad if the demonstrations have units.

        It begins at the demonstrated speed; where recordings begin while moving, a robot at rest needs a ramp.

        Parameters
        ----------
        rate : float, default=1000.0
            Rate of the rows in Hz; the last row is at the end, ``duration_ / speed + settle``, and may follow sooner.
        settle : float, default=0.0
            Extra time in s after the movement, in which it comes to rest at the goal. A movement that was cut while
            moving brakes along its path, half before its end and half after. Gains are at first those of the goal;
            within a tenth to a half of the duration, where no data are near, on_unknown="soft" makes the robot
            compliant. With phase_input="s" models that extrapolate flatly in s keep it stiff.
        goal, start : array-like of shape (d,), default=None
            Goal and start in the units of the recordings; None are ``goal_`` and ``start_``, or after :meth:`condition`
            the ends of the bent movement: give ``goal_`` where the goal must not move with it. With a model of whole
            movements ends that are given are met, stiffly, as via points are, ``goal_`` itself too. A moving goal is
            (n, d), one row each, without ``via``. Poses, here and in ``via``, are p positions and a unit quaternion
            w x y z, or p + 3 outputs.
        via : sequence of (time, position), default=None
            Points that the movement passes, stiff enough to meet them: movement time in s from its start, and position
            (d,) in the units of the recordings, NaN where an output is free (a rotation as a whole). ``covariance``
            must be a model of whole movements. With one, goals and starts too bend the movement as far as
            demonstrations make likely, and the primitive does the rest. Unlikely points raise a warning.
        speed : float, default=1.0
            Rate of movement time: at 0.5 the movement takes twice as long. Gains are those at the movement time.
        limits : MotionLimits or None
            Limits beyond which units must be wrong, by default 600 s, 10 m, 10 m/s; None is no limits. They apply to
            recordings in units of length or without units.

        Raises
        ------
        ValueError
            If there are fewer than two ticks, they do not fit in memory, or the motion exceeds ``limits``.
        """
        check_is_fitted(self)
        speed = checks.number(speed, "speed", above=0.0)
        checks.instance(limits, "limits", MotionLimits, optional=True)
        outputs, bounds = self.outputs_, limits if {*(self.outputs_.units or ())} <= {*LENGTHS} else None
        self._refuse_beyond(bounds, duration=self.duration_ / speed)
        time = tick_times(self.duration_ / speed, rate, self.n_outputs_, settle=settle)
        goal, start = self._place(goal, "goal", len(time) if via is None else 0), self._place(start, "start")
        bent, goal, start = planned(self, goal, start, via)
        motion, moved = bent.reproduction_.plan(time, goal, start, speed)
        rows: dict[str, Any] = outputs.motion(*motion)
        largest = np.linalg.norm(rows["velocity"][:, : outputs.n_positions], axis=1).max()
        self._refuse_beyond(bounds, distance=np.linalg.norm(np.ptp(rows["position"], axis=0)), speed=largest)
        gains = gains_at(bent, moved, motion[0])
        units = np.multiply.outer(outputs.scales, outputs.scales)
        rows |= gains._asdict() | {"covariance": units * gains.covariance}
        return Schedule(time=time, **rows, **_labels(self))

    def simulate(
        self,
        plant: AdmittancePlant | None = None,
        force: ArrayLike | None = None,
        rate: float = 1000.0,
        *,
        random_state: Any = None,
    ) -> Rollout:
        """Run the schedule on a simulated robot that external forces push.

        Parameters
        ----------
        plant : AdmittancePlant, default=None
            Simulated robot; None is ``AdmittancePlant(mass)`` with this controller's mass. Another mass warns.
        force : array-like of shape (T, d), default=None
            External force in N, one row per tick of the schedule; None is no force.
        rate : float, default=1000.0
            Rate of the ticks in Hz. The last tick may be after the end of the movement and follows its last row.
        random_state : int, RandomState or None, default=None
            Seed of the plant's sensor noise.
        """
        return simulate(self.schedule(rate), force, plant=plant, random_state=random_state)

    def _gains(self, X: ArrayLike) -> Gains:
        """Gains at times X (n, 1)."""
        time = self._movement_time(X)
        return gains_at(self, time, self.reproduction_.motion(time)[0])

    def _place(self, value: ArrayLike | None, name: str, n_ticks: int = 0) -> Floats | None:
        """Goal or start as outputs (d,), None as shown, or a goal that may move, (n_ticks, d)."""
        if value is None:
            return None
        rows, d = self.outputs_.rows(value, name), self.n_outputs_
        return checks.array(rows, name, (n_ticks, d) if n_ticks and rows.ndim > 1 else (d,))

    def _movement_time(self, X: ArrayLike) -> Floats:
        """Movement times (n,) of a column X (n, 1), which may be empty."""
        check_is_fitted(self)
        times = check_array(checked_values(X, "X"), dtype=np.float64, ensure_min_samples=0)
        if times.shape[1] != 1:
            raise ValueError(f"X has {times.shape[1]} features, but DMPController is expecting 1 feature: the time.")
        return np.asarray(self.time_scale_ * (times[:, 0] - self.start_time_))

    def _refuse_beyond(self, limits: MotionLimits | None, **values: Any) -> None:
        """Raise if a duration, distance or speed of a schedule exceeds the limits."""
        for name, value in values.items() if limits is not None else ():
            if value > (most := getattr(limits, name)):
                units = ", ".join(self.outputs_.units or ["none"])
                raise ValueError(
                    f"the {name} of the schedule is {value:.4g} {_UNITS[name]}, must be at most limits.{name}, "
                    f"{most:g} {_UNITS[name]}: correct units ({units}) or time_unit ({self.time_unit_}) of the "
                    "recordings, or a goal, start or via point that leaves too little time; or give "
                    f"limits=MotionLimits({name}=...) or None."
                )


def _labels(controller: Any) -> dict[str, Any]:
    """Names, units, limits and JSON-compatible provenance of the schedules of a fitted controller."""
    law, outputs, mass = controller.law_, controller.outputs_, controller.mass_
    return {
        "names": controller.names_,
        "units": "m" if outputs.unit in LENGTHS else "rad" if outputs.unit in ANGLES else outputs.unit,
        "frame": controller.frame_,
        "stiffness_limits": law.limits(controller.n_outputs_),
        "covariance_of": controller.variability,
        "mass": float(mass) if np.ndim(mass) == 0 else np.asarray(mass),
        "provenance": {
            "controller": _plain(controller),
            "covariance": _plain(controller.covariance_),
            "n_demos": controller.n_demos_,
            "cutoff": controller.cutoff_,
            "sigma_low": law.sigma_low,
            "sigma_high": law.sigma_high,
            **({} if law.rotation is None else {"rotation": asdict(law.rotation)}),
            "torch_pbd": version("torch_pbd"),
        },
    }


def _plain(value: Any) -> Any:
    """Parameter in JSON-compatible form."""
    if isinstance(value, BaseEstimator):
        return {type(value).__name__: {k: _plain(v) for k, v in value.get_params(deep=False).items()}}
    if isinstance(value, StiffnessLaw):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if value is None or isinstance(value, bool | int | float | str | list) else repr(value)
