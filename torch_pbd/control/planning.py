"""Motions and gains of a fitted controller: predicted, bent, planned for a robot, and run in simulation."""

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
from torch_pbd.control.impedance import gains_at
from torch_pbd.control.primitive.outputs import Outputs, counts_as_metres, in_si, robot_unit
from torch_pbd.control.primitive.reproduction import Reproduction
from torch_pbd.control.schedule.rows import tick_times
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.run import simulate
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.control.via import Bend, conditioned, planned
from torch_pbd.estimators.validation import checked_values

_UNITS = {"duration": "s", "distance": "m", "speed": "m/s"}


@final
@dataclass(frozen=True)
class MotionLimits:
    """What is beyond what robots do, so that a schedule is refused: its units cannot be right.

    Parameters
    ----------
    duration : float, default=600.0
        Of the movement, s.
    distance : float, default=10.0
        Diagonal of the box around the path, m; where it lies does not matter.
    speed : float, default=10.0
        In m/s.
    """

    duration: float = 600.0
    distance: float = 10.0
    speed: float = 10.0

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            checks.number(getattr(self, name), name, above=0.0, unit=unit)


_LIMITS = MotionLimits()


class Planning(BaseEstimator):
    """Methods of a fitted `torch_pbd.control.DMPController`; abstract."""

    covariance_: Any
    reproduction_: Reproduction
    outputs_: Outputs
    n_outputs_: int
    units_: tuple[str, ...] | None
    time_unit_: str
    duration_: float
    start_time_: float
    time_scale_: float
    mass: Any
    _bend: Bend | None = None

    @property
    def mass_(self) -> float | Floats:
        """Virtual mass that gains are made for: a number of kg, or of kg m^2 for angles; or a matrix (d, d)."""
        check_is_fitted(self)
        return self.outputs_.mass(self.mass)

    def predict(self, X: ArrayLike) -> Floats:
        """Reproduced outputs (n, d) at times X (n, 1), which count as those of the demonstrations do.

        Positions, and of poses three coordinates of a rotation, see :meth:`predict_pose`. From ``start_time_``; the
        movement is over ``duration_`` later, and then stays at the goal.
        """
        return self._path(self._movement_time(X))

    def predict_pose(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Reproduced positions (n, p) and orientations (n, 4), unit quaternions w x y z, at times X (n, 1)."""
        path = self.predict(X)
        if self.outputs_.reference is None:
            raise ValueError("The demonstrations have no rotation: predict(X) is all of the movement.")
        return self.outputs_.poses(path)

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariance (n, d, d) of the outputs at times X (n, 1), in their squared units: of poses in their chart."""
        inputs = self.reproduction_.phase(self._movement_time(X))
        return self.outputs_.covariance(self.covariance_.predict_cov(inputs))

    def condition(self, times: ArrayLike, positions: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy of a movement that passes there: where a robot was pushed to, what was seen so far, a via point.

        The rest of the movement, and its gains, follow as demonstrations make likely. ``covariance`` must be a model of
        whole movements, with variability="position". A copy can be conditioned again.

        Parameters
        ----------
        times : array-like of shape (m,)
            Times, which count as those of the demonstrations do.
        positions : array-like of shape (m, d), or (m, p + 4) for poses
            In their units; NaN where an output is not given. Of poses p positions and a quaternion w x y z, or outputs;
            a rotation is given whole or not at all.
        noise_scale : float or array-like of shape (d,), default=0.0
            Standard deviation of the error of positions; of poses p numbers, and three in rad.
        """
        time = self._movement_time(checks.array(times, "times", ("m",))[:, np.newaxis])
        position = self.outputs_.rows(positions, "positions")
        if position.shape != (len(time), self.n_outputs_):
            raise ValueError(f"positions has shape {position.shape}, must have shape ({len(time)}, {self.n_outputs_}).")
        if self.outputs_.reference is not None and np.ndim(noise_scale) == 0 and noise_scale != 0.0:
            must = f"0, or {self.n_outputs_} numbers, the last three in rad"
            raise checks.refusal(noise_scale, "noise_scale", must, "m and rad have no scale in common")
        return conditioned(self, time, position - self._path(time), noise_scale)

    def predict_stiffness(self, X: ArrayLike) -> Floats:
        """Stiffness (n, d, d) at times X (n, 1): in N/m, of angles in Nm/rad, of poses in both and in world axes."""
        time = self._movement_time(X)
        return gains_at(self, time, self._path(time)).stiffness

    def predict_damping(self, X: ArrayLike) -> Floats:
        """Damping (n, d, d) at times X (n, 1), in N s/m or Nm s/rad."""
        time = self._movement_time(X)
        return gains_at(self, time, self._path(time)).damping

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
        """Motion and gains at ``rate``, for a robot: in s, m and rad, if the demonstrations tell units.

        It begins at the speed that was shown. Where recordings were cut while moving, a robot at rest needs a ramp.

        Parameters
        ----------
        rate : float, default=1000.0
            In Hz; the last row is at the end, ``duration_ / speed + settle``, and may follow sooner.
        settle : float, default=0.0
            How long to go on after the movement, in s: it then comes to rest at the goal. One that was cut while moving
            brakes on its own path, half before its end and half after. Of what comes after it nothing was shown, so
            that on_unknown="soft" makes the robot compliant there.
        goal, start : array-like of shape (d,), default=None
            In the units of the recordings; None are ``goal_`` and ``start_``. A goal (n, d) is that at each row. Of
            poses, here and in ``via``, p positions and a unit quaternion w x y z, p + 4 numbers; or the p + 3 outputs.
        via : sequence of (time, position), default=None
            Points that the movement passes, with the stiffness of what must be met there: movement time in s from its
            start, and position (d,) in the units of the recordings, NaN where an output is free (a rotation as a
            whole). ``covariance`` must be a model of whole movements: with one, goals and starts too bend the movement
            as far as demonstrations make likely, and the primitive does the rest. A warning tells of points that they
            make unlikely.
        speed : float, default=1.0
            How fast movement time passes: at 0.5 the movement takes twice as long. Gains are those of movement time.
        limits : MotionLimits or None
            What no robot does, default 600 s, 10 m, 10 m/s; None is no limits. They hold for recordings in units of
            length, and such without units.

        Raises
        ------
        ValueError
            If there are less than two ticks, they do not fit in memory, or the motion is beyond ``limits``.
        """
        check_is_fitted(self)
        speed = checks.number(speed, "speed", above=0.0)
        checks.instance(limits, "limits", MotionLimits, optional=True)
        units, outputs = self.outputs_.units(self.units_), self.outputs_
        bounds = limits if counts_as_metres(units) else None
        self._refuse_beyond(bounds, "duration", self.duration_ / speed)
        time = tick_times(self.duration_ / speed, rate, self.n_outputs_, settle=settle)
        goal, start = (
            None if value is None else outputs.rows(value, name) for name, value in (("goal", goal), ("start", start))
        )
        bent, goal, start = planned(self, goal, start, via)
        path, velocity, acceleration, moved = bent._motion(time, goal, start, speed)
        unit = in_si(units)
        rows: dict[str, Any] = outputs.motion(path, velocity, acceleration, unit)
        self._refuse_beyond(bounds, "distance", float(np.linalg.norm(np.ptp(rows["position"], axis=0))))
        speeds = np.linalg.norm(rows["velocity"][:, : outputs.n_positions], axis=1)
        self._refuse_beyond(bounds, "speed", float(speeds.max()))
        gains, scales = gains_at(bent, moved, path), outputs.scales(unit)
        rows |= gains._asdict() | {"covariance": np.multiply.outer(scales, scales) * gains.covariance}
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
            None is ``AdmittancePlant(mass)`` with the mass of this controller; a warning tells of another mass.
        force : array-like of shape (T, d), default=None
            External force in N, one row for each of the schedule's ticks; None is none.
        rate : float, default=1000.0
            Of the ticks, Hz. The last one, which may be later than the end of the movement, follows its last row.
        random_state : int, RandomState or None, default=None
            Of the noise of the plant's sensor.
        """
        return simulate(self.schedule(rate), force, plant=plant, random_state=random_state)

    def phase(self, time: ArrayLike) -> Floats:
        """Inputs (n, 1) of ``covariance_`` at movement times (n,), which start at 0: what ``phase_input`` says."""
        check_is_fitted(self)
        return self.reproduction_.phase(checks.array(time, "time", ("n",)))

    def _path(self, time: Floats) -> Floats:
        """Reproduced position (n, d) at movement times (n,)."""
        position = self.reproduction_.motion(time)[0]
        return position if self._bend is None else position + self._bend(time)

    def _motion(
        self, time: Floats, goal: Floats | None, start: Floats | None, speed: float
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Outputs, their velocity and acceleration (n, d) at times (n,), and the movement time of the gains there."""
        position, velocity, acceleration, moved = self.reproduction_.plan(time, goal, start, speed)
        if self._bend is not None:
            pace = np.gradient(moved, time)
            rate, slope = pace[:, np.newaxis], np.gradient(pace, time)[:, np.newaxis]
            position, velocity = position + self._bend(moved), velocity + rate * self._bend(moved, 1)
            acceleration = acceleration + rate**2 * self._bend(moved, 2) + slope * self._bend(moved, 1)
        return position, velocity, acceleration, moved

    def _movement_time(self, X: ArrayLike) -> Floats:
        """Movement times (n,) of a column X (n, 1), which may be empty."""
        check_is_fitted(self)
        times = check_array(checked_values(X, "X"), dtype=np.float64, ensure_min_samples=0)
        if times.shape[1] != 1:
            raise ValueError(f"X has {times.shape[1]} features, but DMPController is expecting 1 feature: the time.")
        return np.asarray(self.time_scale_ * (times[:, 0] - self.start_time_))

    def _refuse_beyond(self, limits: MotionLimits | None, name: str, value: float) -> None:
        """Refuse a duration, distance or speed, by name, beyond the limits."""
        if limits is not None and value > (most := getattr(limits, name)):
            units = ", ".join(self.outputs_.units(self.units_) or ["none"])
            raise ValueError(
                f"the {name} of the schedule is {value:.4g} {_UNITS[name]}, must be at most limits.{name}, {most:g} "
                f"{_UNITS[name]}: correct units ({units}) or time_unit ({self.time_unit_}) of the recordings, or give "
                f"limits=MotionLimits({name}=...) or None."
            )


def _labels(controller: Any) -> dict[str, Any]:
    """Names, units and limits of the schedules of a fitted controller, and what they come from, as JSON can hold it."""
    law, mass = controller.law_, controller.mass_
    return {
        "names": controller.names_,
        "units": robot_unit(controller.outputs_.units(controller.units_)),
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
    """Parameter as JSON can hold it."""
    if isinstance(value, BaseEstimator):
        return {type(value).__name__: {k: _plain(v) for k, v in value.get_params(deep=False).items()}}
    if isinstance(value, StiffnessLaw):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if value is None or isinstance(value, bool | int | float | str | list) else repr(value)
