"""Movements bent by observations: through via points, to likely goals, or on from where a robot is.

A conditioned model of whole movements predicts how the rest of a movement changes. That change, over movement time, is
added to the reproduced path; gains come from the conditioned covariance. Goals that the demonstrations make unlikely
are left to the movement primitive, which reaches any goal; what is unlikely of via points, to minimum jerk.
"""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, CubicSpline
from scipy.stats import f

from torch_pbd import checks
from torch_pbd.checks import Floats

_N_KNOTS = 200  # knots of a change over a movement, whose length scales are at least a fiftieth of it
# Standard deviations beyond which nobody deviates: steps of left-out demonstrations were up to 23 away.
_FAR = 30.0
_LIKELY = 0.95  # share of demonstrations beyond whose deviation a point counts as unlikely


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
    shown, inputs, stays = getattr(controller, "_shown", model), phase(time), phase(np.array(pins))
    _warn_of_far(change, outputs.covariance(shown.predict_cov(inputs)), noise_scale)
    bent = model.condition(inputs, outputs.decode(model.predict(inputs)) + change, noise_scale=noise_scale)
    moved = bent.condition(stays, outputs.decode(model.predict(stays))) if len(pins) else bent
    # Knots are even, except next to observed times, where the change must be exact.
    own = np.append(time, pins).clip(0.0, controller.duration_)
    even = np.linspace(0.0, controller.duration_, _N_KNOTS)
    far = np.abs(even[:, np.newaxis] - own).min(axis=1, initial=np.inf) > 0.25 * even[1]
    knots = np.unique(np.append(even[far], own))
    result = copy.copy(controller)
    result.covariance_, result._shown = bent, shown
    result.reproduction_ = copy.copy(controller.reproduction_)
    changes = outputs.decode(moved.predict(phase(knots)) - shown.predict(phase(knots)))
    result.reproduction_.bend = CubicSpline(knots, changes)
    return result


def _warn_of_far(change: Floats, covariance: Floats, noise_scale: ArrayLike) -> None:
    """Warn of changes (m, d), NaN where free, that are no deviation of people but an error of a robot, or of units."""
    variance = np.diagonal(covariance, axis1=1, axis2=2) + np.square(noise_scale)
    far = np.nan_to_num(np.abs(change) / np.sqrt(variance.clip(np.finfo(float).tiny)))
    row, output = np.unravel_index(far.argmax(), far.shape) if far.size else (0, 0)
    if far.size and far[row, output] > _FAR:
        checks.warn(
            f"positions[{row}, {output}] is {far[row, output]:.3g} standard deviations from the movement: others "
            "move as far along a correlation that is hardly known. Give noise_scale, the robot's error, or mend units."
        )


def planned(
    controller: Any, goal: Floats | None, start: Floats | None, via: Sequence[tuple[float, ArrayLike]] | None
) -> tuple[Any, Floats | None, Floats | None]:
    """Controller conditioned on a goal, a start and via points, and the goal and start left to its primitive.

    A point that deviates by more than 95 % of demonstrations raises a warning and is passed all the same. What is
    beyond these changes the given outputs alone, by minimum jerk: a correlation that is hardly known, times thousands
    of standard deviations, would move the others by metres.
    """
    if via is None and (not can_bend(controller) or (goal is None and start is None)):
        return controller, goal, start
    can_bend(controller, must=True)
    points = _checked_points(via, controller)
    rest, known, pins = {"goal": goal, "start": start}, [], []
    for name, at, own in (("start", 0.0, controller.start_), ("goal", controller.duration_, controller.goal_)):
        target = rest[name]
        if target is not None and target.ndim > 1:
            continue  # a goal that moves
        change = own - own if target is None else target - own
        if not change.any():
            pins.append(at)
            continue
        share = _likely_share(controller, at, change)
        rest[name] = None if share == 1.0 else own + (1.0 - share) * change
        known.append((at, share * change))
    even = np.linspace(0.0, controller.duration_, 2 * controller.n_steps)
    path = (
        CubicSpline(even, controller.reproduction_.plan(even, rest["goal"], rest["start"], 1.0)[0]) if points else None
    )
    zero = np.zeros(controller.n_outputs_)
    beyond = {0.0: zero, controller.duration_: zero}  # by movement time
    for number, (at, position) in enumerate(points):
        change = position - path(at)
        share = _likely_share(controller, at, change, f"via[{number}]")
        known.append((at, share * change))
        beyond[at] = (1.0 - share) * np.nan_to_num(change)
    times, changes = np.array([at for at, _ in known]), [change for _, change in known]
    # A controller that was conditioned may know its start or its end already.
    phase, before = controller.reproduction_.phase, controller.covariance_._known.time
    pins = [at for at in pins if at not in times and not np.isclose(phase(np.array([at]))[0, 0], before).any()]
    bent = conditioned(controller, times, np.reshape(changes, (-1, controller.n_outputs_)), pins=pins)
    jerk = BPoly.from_derivatives(sorted(beyond), [(beyond[at], zero, zero) for at in sorted(beyond)])
    likely = bent.reproduction_.bend
    bent.reproduction_.bend = CubicSpline(likely.x, likely(likely.x) + jerk(likely.x))
    return bent, rest["goal"], rest["start"]


def _checked_points(via: Any, controller: Any) -> list[tuple[float, Floats]]:
    """Movement times and outputs of via points, NaN where free."""
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
        points.append((at, position))
    return points


def _likely_share(controller: Any, at: float, change: Floats, name: str = "") -> float:
    """Share of a change of the given outputs within which 95 % of demonstrations lie; less warns, if it has a name."""
    given = ~np.isnan(change)
    inputs, size = controller.reproduction_.phase(np.array([at])), int(given.sum())
    covariance = controller.outputs_.covariance(controller.covariance_.predict_cov(inputs))[0][np.ix_(given, given)]
    degrees = min(float(controller.covariance_.predict_df(inputs)[0]), 1e12)  # infinite ones are not for f
    distance = float(change[given] @ np.linalg.solve(covariance, change[given])) ** 0.5  # Mahalanobis distance
    limit = float(size * f.ppf(_LIKELY, size, degrees) * (degrees - 2.0) / degrees) ** 0.5
    if name and distance > limit:
        checks.warn(
            f"{name}, at {at:g} s, is {distance:.3g} standard deviations from the movement, where "
            f"{limit:.3g} hold {_LIKELY:.0%} of demonstrations: how people would pass there was not shown."
        )
    return limit / max(distance, limit)
