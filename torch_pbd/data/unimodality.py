"""Do the demonstrations follow one way, or several? A normal distribution cannot tell of two."""

import warnings
from typing import NamedTuple

import numpy as np

from torch_pbd import checks
from torch_pbd.data.alignment import Floats
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.exceptions import UnimodalityWarning

_N_STEPS = 20
_LEAST_DEMOS = 6
# Of the whole demonstrations, and at a step: gain of the criterion, and distance of the two means in standard
# deviations within the groups. Two halves of a uniform distribution are at 3.5.
_GAIN_WHOLE, _SEPARATION_WHOLE = 8.0, 6.0
_GAIN_STEP, _SEPARATION_STEP = 10.0, 4.5
_SHARE_OF_STEPS, _SHARE_OF_DEMOS = 0.25, 0.2


class _Split(NamedTuple):
    gain: float
    separation: float
    first: frozenset[int]


def check_unimodal(demonstrations: Demonstrations) -> bool:
    """Whether the demonstrations look like one way to do the task; warns if they do not.

    The paper assumes one mode (Section II): between two ways around an obstacle, a mean goes through it. Looked at
    are the direction in which the whole demonstrations differ most, and that at each of 20 steps: their places
    along it are split into two groups with a common variance, and the split must be worth it by the Bayesian
    information criterion and lie wide apart. Subtle cases are missed, and fewer than six demonstrations pass.

    Parameters
    ----------
    demonstrations : Demonstrations
        Aligned by phase here, if they are not.

    Returns
    -------
    bool

    Warns
    -----
    UnimodalityWarning
        If there are two groups, or one demonstration far from all others.
    """
    checks.instance(demonstrations, "demonstrations", Demonstrations)
    if len(demonstrations) < _LEAST_DEMOS:
        return True
    aligned = demonstrations if demonstrations.is_aligned else demonstrations.align()
    residual = aligned.to_array() - aligned.to_array().mean(axis=0)
    deviation = residual.std(axis=(0, 1))
    residual = residual / np.where(deviation > 0, deviation, 1.0)
    n_demos, n_steps, _ = residual.shape
    whole = _best_split(residual.reshape(n_demos, -1))
    found = whole if whole.gain > _GAIN_WHOLE and whole.separation > _SEPARATION_WHOLE else None
    if found is None:
        steps = [_best_split(residual[:, t]) for t in np.linspace(0, n_steps - 1, _N_STEPS).astype(int)]
        least = _SHARE_OF_DEMOS * n_demos
        clear = [s for s in steps if s.gain > _GAIN_STEP and s.separation > _SEPARATION_STEP and len(s.first) >= least]
        if len(clear) < _SHARE_OF_STEPS * _N_STEPS:
            return True
        found = max(clear, key=lambda split: split.gain)
    _warn(sorted(found.first), n_demos)
    return False


def _best_split(residual: Floats) -> _Split:
    """Best split of the rows in two along the direction in which they differ most; the smaller group first."""
    left, singular, _ = np.linalg.svd(residual, full_matrices=False)
    place = left[:, 0] * singular[0]
    order = np.argsort(place, kind="stable")
    x, n = place[order], len(place)
    total = np.square(x - x.mean()).sum()
    if total <= 1e-18 * n:
        return _Split(0.0, 0.0, frozenset())
    count = np.arange(1, n)
    before, squares = np.cumsum(x)[:-1], np.cumsum(x * x)[:-1]
    within = squares - before**2 / count + (x @ x - squares) - (x.sum() - before) ** 2 / (n - count)
    within = np.maximum(within, 1e-9 * total)
    share = count / n
    entropy = share * np.log(share) + (1 - share) * np.log(1 - share)
    gain = -n * np.log(within / total) + 2 * n * entropy - 2 * np.log(n)
    best = int(gain.argmax())
    apart = (x[best + 1 :].mean() - x[: best + 1].mean()) / np.sqrt(within[best] / n)
    groups = order[: best + 1], order[best + 1 :]
    return _Split(float(gain[best]), float(apart), frozenset(int(k) for k in min(groups, key=len)))


def _warn(few: list[int], n_demos: int) -> None:
    if len(few) == 1:
        what = f"Demonstration {few[0]} is far from the other {n_demos - 1}: look at it, and leave it out if it failed."
    else:
        what = (
            f"The demonstrations seem to follow two ways: {', '.join(map(str, few))} differ from the others. A normal "
            "distribution puts its mean between them; learn each way by itself."
        )
    warnings.warn(what, UnimodalityWarning, stacklevel=3)
