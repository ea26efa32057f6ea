"""Judgement of laws of whole movements: a demonstration that was left out, and statements on all of it."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats

MOVEMENT_STATISTICS = ("deviation", "offset", "length", "largest")
"""Statistics of whole movements, of :func:`movement_statistics`."""


def movement_statistics(movements: ArrayLike, mean: ArrayLike, std: ArrayLike) -> Floats:
    """Statistics of whole movements: (s, 4), in the order of ``MOVEMENT_STATISTICS``.

    The mean squared deviation and the length of the time-averaged offset, in standard deviations of each step and
    output; the length of the path, in units of the outputs; the largest deviation, in standard deviations.

    Parameters
    ----------
    movements : array_like of shape (s, n, d)
    mean, std : array_like of shape (n, d)
        Of each step.
    """
    movements = checks.array(movements, "movements", ("s", "n", "d"))
    mean, std = (checks.array(part, name, movements.shape[1:]) for part, name in ((mean, "mean"), (std, "std")))
    standardized = (movements - mean) / std
    offset = np.linalg.norm(standardized.mean(axis=1), axis=1)
    length = np.linalg.norm(np.diff(movements, axis=1), axis=2).sum(axis=1)
    columns = np.square(standardized).mean(axis=(1, 2)), offset, length, np.abs(standardized).max(axis=(1, 2))
    return np.stack(columns, axis=1)


def judge_movement(
    model: Any, X: ArrayLike, y: ArrayLike, *, level: float = 0.9, n_draws: int = 500, random_state: Any = 0
) -> dict[str, float]:
    """Joint log density of one demonstration, in nats, and whether regions of whole movements hold it.

    Of a model of movements it is the law of whole movements that is judged, of a regressor that of independent rows.

    Parameters
    ----------
    model : fitted movement model or covariance regressor
    X, y : array_like of shapes (n, 1) and (n, d) or (n,)
        The demonstration, in the order of its times.
    level : float, default=0.9
        Share of draws that lie in a region, as many below it as above, for each of ``MOVEMENT_STATISTICS``.
    n_draws : int, default=500
    random_state : int, RandomState instance or None, default=0

    Returns
    -------
    dict
        "joint", and 1.0 or 0.0 for each statistic.
    """
    mean, covariance = model.predict(X, return_cov=True)
    shape = covariance.shape[:2]
    if hasattr(model, "sample_demonstrations"):
        draws = model.sample_demonstrations(X, n_draws, random_state)
        joint = float(model.score_demonstrations(X, y)[0])
    else:
        # Rows of a regressor are independent of each other: a movement is one draw of each.
        draws = model.sample_y(X, n_draws, random_state).reshape(*shape, n_draws).transpose(2, 0, 1)
        joint = float(np.sum(model.log_likelihood(X, y)))
    moments = mean.reshape(shape), np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    low, high = np.quantile(movement_statistics(draws, *moments), [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    own = movement_statistics(np.reshape(y, (1, *shape)), *moments)[0]
    return {"joint": joint} | dict(zip(MOVEMENT_STATISTICS, ((low <= own) & (own <= high)).astype(float), strict=True))
