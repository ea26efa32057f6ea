"""Movements bent by observations: through via points, to likely goals, or on from where a robot is.

A conditioned model of whole movements predicts how the rest of a movement changes. That change, over movement time, is
added to the reproduced path; gains come from the conditioned covariance. Goals that the demonstrations make unlikely
are left to the movement primitive, which reaches any goal; what is unlikely of via points, to quintics of minimum jerk
from rest to rest: the change that they add has no velocity and no acceleration at any point.
"""

import copy
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, CubicSpline
from scipy.stats import f

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError

_N_KNOTS = 200  # knots of a change over a movement, whose length scales are at least a fiftieth of it
_BESIDE = 1e-4  # share of their distance by which these are beside an observed time
# Standard deviations beyond which nobody deviates: steps of left-out demonstrations were up to 23 away.
_FAR = 30.0
_AGREE = 1e-4  # share of the movement's extent by which points at one time may differ: 30 um of 0.3 m
_LIKELY = 0.95  # share of demonstrations beyond whose deviation a point counts as unlikely


class _Point(NamedTuple):
    """Place (d,) to be at a movement time, NaN where free."""

    name: str
    at: float
    place: Floats


def can_bend(controller: Any, *, must: bool = False) -> bool:
    """Whether the covariance is a model of whole movements of positions; if it must be, others are refused."""
    able = hasattr(controller.covariance_, "condition") and controller.variability == "position"
    if must and not able:
        needed = "a model of whole movements, with variability='position', to be bent"
        raise checks.refusal(controller.covariance, "covariance", needed, "take DMPController(TrajectoryRegressor())")
    return able


def conditioned(
    controller: Any, time: Floats, change: Floats, noise_scale: Any = 0.0, pins: Sequence[float] = ()
) -> Any:
    """Copy of a fitted controller whose path changes by (m, d), NaN where free, at movement times (m,).

    At the movement times ``pins`` the path stays, without effect on the gains. Changes are relative to the path, which
    differs from the model's mean by the error of the reproduction.
    """
    can_bend(controller, must=True)
    outputs, phase = controller.outputs_, controller.reproduction_.phase
    # Observations are in outputs, any of which may be free, while poses are learned along other axes.
    model = controller.covariance_.observed_along(outputs.axes)
    place, covariance = _in_model(controller, np.append(time, pins))
    bent = model.condition(phase(time), place[: len(time)] + change, noise_scale=noise_scale)
    if len(time):
        _warn_of_far(controller, time, change, covariance[: len(time)], noise_scale)
    # Pins are where the model has them: the path, smooth, may be off by what is many of its deviations at an end.
    stays = phase(np.array(pins))
    moved = bent.condition(stays, outputs.decode(model.predict(stays))) if len(pins) else bent
    result = copy.copy(controller)
    result.covariance_, result._shown = bent, getattr(controller, "_shown", model)
    result.reproduction_ = copy.copy(controller.reproduction_)
    result.reproduction_.bend = _smooth(result, moved, pins, place[len(time) :])
    return result


def _smooth(controller: Any, moved: Any, pins: Sequence[float], pinned: Floats) -> CubicSpline:
    """Change of a conditioned controller's path, over movement time, that keeps it at places ``pinned`` (m, d).

    At observed times models predict a step's independent part too, trembling or noise, of which a plan would be a kink:
    the change is that of the times beside them, and what is then left at exact points goes from rest to rest.
    """
    outputs, reproduction = controller.outputs_, controller.reproduction_
    bent, shown = controller.covariance_, controller._shown
    even, known = np.linspace(0.0, controller.duration_, _N_KNOTS), reproduction.time_of(bent._known.time)
    beside = np.abs(even[:, np.newaxis] - np.append(known, pins)).min(axis=1, initial=np.inf) < _BESIDE * even[1]
    inputs = reproduction.phase(even + np.where(even > 0.5 * even[-1], -_BESIDE, _BESIDE) * even[1] * beside)
    exact = bent._known.exact.any(axis=1) & (np.abs(known - 0.5 * even[-1]) <= 0.5 * even[-1] + _rounding(controller))
    at = np.append(known[exact], pins).clip(0.0, even[-1])
    there = [inputs, bent._known.time[exact, np.newaxis], reproduction.phase(np.array(pins))]
    before, here = np.split(outputs.decode(shown.predict(np.concatenate(there))), [_N_KNOTS])
    smooth = CubicSpline(even, outputs.decode(moved.predict(inputs)) - before)
    if not len(at):
        return smooth
    aims = np.where(bent._known.exact, bent._known.value, np.nan)[exact].reshape(-1, controller.n_outputs_)
    left = np.concatenate([aims, pinned]) - here - smooth(at)
    far = np.abs(even[:, np.newaxis] - at).min(axis=1) > 0.25 * even[1]
    knots = np.unique(np.append(even[far], at))
    knots = knots[np.diff(knots, prepend=-np.inf) > _rounding(controller)]
    changes = smooth(knots) + _rest_to_rest(controller, list(zip(at.tolist(), left, strict=True)), knots)
    return CubicSpline(knots, changes)


def _in_model(controller: Any, time: Floats) -> tuple[Floats, Floats]:
    """Places (n, d) of the path at movement times (n,), and the covariances there before anything was known.

    But for the error of the path's reproduction of the model's mean.
    """
    shown, reproduction = getattr(controller, "_shown", controller.covariance_), controller.reproduction_
    mean, covariance = shown.predict(reproduction.phase(time), return_cov=True)
    bend = 0.0 if reproduction.bend is None else reproduction.bend(time.clip(0.0, controller.duration_))
    return controller.outputs_.decode(mean) + bend, controller.outputs_.covariance(covariance)


def _warn_of_far(controller: Any, time: Floats, change: Floats, covariance: Floats, noise_scale: ArrayLike) -> None:
    """Warn of changes (m, d), NaN where free, that are no deviation of people but an error of a robot, or of units."""
    variance = np.diagonal(covariance, axis1=1, axis2=2) + np.square(noise_scale)
    far = np.nan_to_num(np.abs(change) / np.sqrt(variance.clip(np.finfo(float).tiny)))
    row, output = np.unravel_index(far.argmax(), far.shape)
    if far[row, output] > _FAR:
        at = time[row] / controller.time_scale_ + controller.start_time_  # as the caller gave it
        checks.warn(
            f"{controller.names_[output]} of positions, at {at:g} {controller.time_unit_}, is {far[row, output]:.3g} "
            "standard deviations from the movement: other outputs may then move as far. Give noise_scale, the robot's "
            "error in the units of positions, or correct the units."
        )


def planned(
    controller: Any, goal: Floats | None, start: Floats | None, via: Sequence[tuple[float, ArrayLike]] | None
) -> tuple[Any, Floats | None, Floats | None]:
    """Controller conditioned on a goal, a start and via points, and the goal and start left to its primitive.

    A point that deviates by more than 95 % of demonstrations, of those that pass the points before it, raises a warning
    and is passed all the same. What is beyond these changes the given outputs alone, as :func:`_rest_to_rest` has it: a
    correlation that is hardly known, times thousands of standard deviations, would move the others by metres.
    """
    if via is None and (not can_bend(controller) or (goal is None and start is None)):
        return controller, goal, start
    can_bend(controller, must=True)
    duration, reproduction = controller.duration_, controller.reproduction_
    known, rest = _known_points(controller), {"start": start, "goal": goal}
    at_ends, own = {"start": 0.0, "goal": duration}, {"start": controller.start_, "goal": controller.goal_}
    given = [_Point(name, at_ends[name], aim) for name, aim in rest.items() if aim is not None and aim.ndim == 1]
    points = _distinct(_checked_points(via, controller), [*known, *given], controller)
    here = own
    if len(controller.covariance_._known.time):  # observations, those with noise too, moved the ends of the path
        here = dict(zip(at_ends, reproduction.motion(np.array([0.0, duration]))[0], strict=True))
    ends = [end._replace(place=end.place - here[end.name]) for end in _distinct(given, known, controller)]
    taken = np.array([point.at for point in (*known, *points, *ends)])
    rest = {name: aim if aim is not None and aim.ndim > 1 else None for name, aim in rest.items()}  # goals that move
    still = [at_ends[name] for name, aim in rest.items() if aim is None]
    pins = [at for at in still if (np.abs(taken - at) > _rounding(controller)).all()]
    likely = _Likely(controller, pins)
    for end in ends:
        if (left := np.nan_to_num(likely.add(end.at, end.place))).any():
            rest[end.name] = own[end.name] + left
    path = _path_to(rest["goal"], rest["start"], controller)
    # What was known stays, wherever the primitive takes the path.
    beyond = [(at, place - path(at)) for _, at, place in known if ends]
    beyond += [(at, likely.add(at, place - path(at), name)) for name, at, place in points]
    changes = np.reshape(likely.changes, (-1, controller.n_outputs_))
    bent = conditioned(controller, np.array(likely.times), changes, pins=pins)
    bend = bent.reproduction_.bend
    bent.reproduction_.bend = CubicSpline(bend.x, bend(bend.x) + _rest_to_rest(controller, beyond, bend.x))
    return bent, rest["goal"], rest["start"]


def _path_to(goal: Floats | None, start: Floats | None, controller: Any) -> CubicSpline:
    """Places (d,) of the primitive to another goal from another start, over movement time."""
    goal = goal if goal is None or goal.ndim == 1 else None  # of one that moves nobody knows the path
    even = np.linspace(0.0, controller.duration_, 20 * controller.n_steps)  # the equation is solved tick by tick
    return CubicSpline(even, controller.reproduction_.plan(even, goal, start, 1.0)[0][0])


class _Likely:
    """Changes that demonstrations make likely, of one point after another, each given those before it.

    Two points may each be likely, and no movement pass both. At the movement times ``pins`` the path stays.
    """

    def __init__(self, controller: Any, pins: Sequence[float]) -> None:
        self.times, self.changes = list[float](), list[Floats]()
        self._controller, self._outputs = controller, controller.outputs_
        self._model = controller.covariance_.observed_along(self._outputs.axes)
        self._least = np.diag(np.square(checks.ROUNDING * _extents(controller)))
        if pins:
            stays = controller.reproduction_.phase(np.array(pins))
            self._model = self._model.condition(stays, self._outputs.decode(self._model.predict(stays)))

    def add(self, at: float, change: Floats, name: str = "") -> Floats:
        """What of a change, NaN where free, is beyond 95 % of demonstrations; if a named point's is, it warns."""
        inputs, given = self._controller.reproduction_.phase(np.array([at])), ~np.isnan(change)
        before = _in_model(self._controller, np.array([at]))[0][0]
        now = self._outputs.decode(self._model.predict(inputs))[0]
        left, size = change - (now - before), int(given.sum())
        # Of an end that is known nearly without noise rounding leaves no more than this.
        covariance = self._outputs.covariance(self._model.predict_cov(inputs))[0] + self._least
        covariance = covariance[np.ix_(given, given)]
        degrees = min(float(self._model.predict_df(inputs)[0]), 1e12)  # infinite ones are not for f
        distance = max(0.0, float(left[given] @ np.linalg.solve(covariance, left[given]))) ** 0.5  # Mahalanobis
        limit = float(size * f.ppf(_LIKELY, size, degrees) * (degrees - 2.0) / degrees) ** 0.5
        if name and distance > limit:
            checks.warn(
                f"{name}, at {at:g} s, is {distance:.3g} standard deviations from the movement, where "
                f"{limit:.3g} hold {_LIKELY:.0%} of demonstrations: how people would pass there was not shown."
            )
        beyond = (1.0 - limit / max(distance, limit)) * left
        self._model = self._model.condition(inputs, (before + change - beyond)[np.newaxis])
        self.times.append(at)
        self.changes.append(change - beyond)
        return beyond


def _rest_to_rest(controller: Any, beyond: list[tuple[float, Floats]], time: Floats) -> Floats:
    """Changes (n, d) at movement times (n,): those ``beyond``, NaN where free, and none at ends and known values.

    Each output goes alone, between its own points by quintics, which are of minimum jerk from rest to rest.
    """
    known, duration = controller.covariance_._known, controller.duration_
    changes = np.zeros((len(time), controller.n_outputs_))
    is_known = ~np.isnan(known.value.reshape(-1, controller.n_outputs_))
    still = np.append(controller.reproduction_.time_of(known.time).clip(0.0, duration), [0.0, duration])
    for output in range(controller.n_outputs_):
        own = {at: change[output] for at, change in beyond if not np.isnan(change[output])}
        # A via point takes the place of an end, and of what was known with noise, whose times come back from phases.
        kept = (np.abs(still[:, np.newaxis] - [*own]) > _BESIDE * duration / _N_KNOTS).all(axis=1)
        kept[:-2] &= is_known[:, output]
        own |= dict.fromkeys(still[kept].tolist(), 0.0)
        points = sorted(own.items())
        curve = BPoly.from_derivatives([at for at, _ in points], [(change, 0.0, 0.0) for _, change in points])
        changes[:, output] = curve(time)
    return changes


def _rounding(controller: Any) -> float:
    """Difference in s of movement times that count as one."""
    return checks.ROUNDING * float(controller.duration_)


def _extents(controller: Any) -> Floats:
    """Extent (d,) of the movement in each output, that of all in its unit."""
    even = np.linspace(0.0, controller.duration_, controller.n_steps)
    return np.asarray(controller.outputs_.extents(controller.reproduction_.motion(even)[0][np.newaxis]))


def _checked_points(via: Any, controller: Any) -> list[_Point]:
    """Via points, in the order of their times."""
    if via is not None and not np.iterable(via):
        raise checks.refusal(via, "via", "a list of pairs, each a time in s and a position")
    points = []
    for number, point in enumerate(() if via is None else via):
        try:
            at, position = point
        except (TypeError, ValueError):
            raise checks.refusal(point, f"via[{number}]", "a time in s and a position") from None
        at = checks.number(at, f"the time of via[{number}]", least=0.0, most=controller.duration_, unit="s")
        name, n_outputs = f"the position of via[{number}]", controller.n_outputs_
        position = controller.outputs_.rows(position, name)
        if position.shape != (n_outputs,) or np.isinf(position).any() or np.isnan(position).all():
            raise checks.refusal(position.tolist(), name, f"{n_outputs} numbers, NaN where free")
        points.append(_Point(f"via[{number}]", at, position))
    return sorted(points, key=attrgetter("at"))


def _known_points(controller: Any) -> list[_Point]:
    """What a conditioned controller knows without noise: where it is there."""
    known, reproduction, middle = controller.covariance_._known, controller.reproduction_, 0.5 * controller.duration_
    times, exact = reproduction.time_of(known.time), known.exact.reshape(-1, controller.n_outputs_)
    inside = exact.any(axis=1) & (np.abs(times - middle) <= middle + _rounding(controller))
    places = np.where(exact, reproduction.motion(times)[0], np.nan)
    return [_Point("what is known", *row) for row in zip(times[inside].tolist(), places[inside], strict=True)]


def _distinct(given: list[_Point], fixed: list[_Point], controller: Any) -> list[_Point]:
    """Points given, those at one time as one, and free where others are ``fixed``, with which they must agree."""
    tolerance, result = _AGREE * _extents(controller), list[_Point]()
    for name, at, place in given:
        for other in (*fixed, *result):
            if abs(at - other.at) > _rounding(controller):
                continue
            differs = np.abs(place - other.place) > tolerance  # not where either is NaN
            if differs.any():
                output = int(differs.argmax())
                raise InvalidParameterError(
                    f"{controller.names_[output]} of {name} is {place[output]:.10g}, must be "
                    f"{other.place[output]:.10g} as of {other.name}, which is at the same time, {at:g} s: leave one of "
                    "them out."
                )
            place = np.where(np.isnan(other.place), place, np.nan)
        twin = next((i for i, other in enumerate(result) if abs(at - other.at) <= _rounding(controller)), None)
        if twin is not None:
            result[twin] = result[twin]._replace(place=np.where(np.isnan(place), result[twin].place, place))
        elif not np.isnan(place).all():
            result.append(_Point(name, at, place))
    return result
